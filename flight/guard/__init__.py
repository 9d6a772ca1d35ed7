"""The guard: a process of its own that owns the wire to the autopilot and alone makes setpoints. See docs/safety.md, Liveness."""
