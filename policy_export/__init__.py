"""The policy file: its contract, its runner (no torch), export from checkpoints and verification."""
