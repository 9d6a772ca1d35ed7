"""What can go wrong with the simulated vehicle. Light to import."""

from __future__ import annotations


class DynamicsError(RuntimeError):
    """The vehicle cannot be simulated, or no longer."""


class DynamicsMissingError(DynamicsError):
    """These dynamics are not installed; the message says what to install."""


class DivergedError(DynamicsError):
    """A state of the vehicle is no longer a finite number; the message names it."""
