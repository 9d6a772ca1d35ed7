"""Public MAVLink clients against `sim-gateway`: can they tell it from PX4? See `python -m campaigns.clients --help`."""
