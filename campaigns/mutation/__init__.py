"""Can the tests of `safety/` fail? Every mutant that cosmic-ray's operators make of it, and accidents written by hand.

Nothing in this package imports `safety`: it is loaded, changed, in forked children only.
"""
