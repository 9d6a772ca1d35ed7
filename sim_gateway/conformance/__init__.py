"""The conformance table: what a real PX4 v1.17 was recorded to do, what the gateway does, same or different.

    python -m sim_gateway.conformance /path/to/px4_reference

`facts` reads the recordings, `bench` has a vehicle with two clients in lockstep, each `*_group` replays one file of recordings.
"""
