"""The whole stack in lockstep, many times, on all cores. May know every house."""
