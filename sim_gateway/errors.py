"""What can go wrong with the simulated vehicle, or with how it was asked for. Light to import."""

from __future__ import annotations


class UsageError(Exception):
    """A mistake of the user's; one line that says what to change."""


class DynamicsError(RuntimeError):
    """The vehicle cannot be simulated, or no longer."""


class DynamicsMissingError(DynamicsError):
    """These dynamics are not installed; the message says what to install."""


class DivergedError(DynamicsError):
    """A state of the vehicle is no longer a finite number; the message names it."""
