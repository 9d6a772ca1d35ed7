"""Policies that try to make the safety filter fail, on the six-degree-of-freedom vehicle."""
