"""What can go wrong with a policy file, each with a message that names the field or says what to change."""

from __future__ import annotations


class PolicyError(Exception):
    """Base of every error of this package."""


class PolicyFileError(PolicyError):
    """The file cannot be flown. `field` names what was wrong: a metadata path, an input, `weights`, `file` ..."""

    def __init__(self, field: str, problem: str) -> None:
        self.field = field
        self.problem = problem
        super().__init__(f"policy file refused: {field}: {problem}")


class PolicyRateError(PolicyError):
    """The policy would be stepped at a rate that it was not trained for."""


class PolicyInputError(PolicyError, ValueError):
    """The observation given to the policy has the wrong shape or type, or holds NaN or infinity."""


class PolicyOutputError(PolicyError):
    """The policy answered with NaN, infinity or a value outside its own limits; its hidden state has been reset."""


class CheckpointError(PolicyError):
    """The checkpoint cannot be read or does not describe a network of this project."""


class VerificationError(PolicyError):
    """The exported graph does not compute what the trained network computes; nothing was written."""
