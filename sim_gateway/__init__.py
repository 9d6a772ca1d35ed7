"""World, LiDAR ray casting, vehicle dynamics, PX4-like autopilot, MAVLink and sensor emulators. Knows no other house."""
