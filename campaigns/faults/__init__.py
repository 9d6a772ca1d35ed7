"""The fault campaign: the catalogue in every phase of flight, the real flight code in simulated time (docs/safety.md)."""
