"""What a user can get wrong, across all houses: each is reported in one line, without a traceback."""

from __future__ import annotations

from flight.errors import FlyError
from policy_export.errors import PolicyFileError, PolicyRateError
from sim_gateway.errors import DynamicsError
from strict_yaml import ConfigError


class ClusterError(Exception):
    """The Ray cluster cannot be used; the message says why."""


class OutputError(Exception):
    """A result cannot be written where it should be; the message says what to change."""


USER_ERRORS = (ClusterError, ConfigError, DynamicsError, FlyError, OutputError, PolicyFileError, PolicyRateError)
