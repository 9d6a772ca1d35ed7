"""What runs on the companion computer. Knows safety and the policy file's contract and runner; no simulator, no torch."""
