"""The filter between policy and vehicle, its messages and frames, and the flight monitors. Knows numpy only."""
