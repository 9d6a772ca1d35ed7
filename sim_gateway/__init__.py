"""World, LiDAR ray casting, vehicle dynamics, PX4-like autopilot, MAVLink and sensor emulators. Knows no other house."""

from sim_gateway.kernel_cache import use_cache_of_these_sources

use_cache_of_these_sources()
