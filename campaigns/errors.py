"""What a user can get wrong, across all houses: each is reported in one line, without a traceback."""

from __future__ import annotations

from flight.errors import FlyError
from policy_export.errors import PolicyFileError, PolicyRateError
from sim_gateway.errors import DynamicsError
from strict_yaml import ConfigError

USER_ERRORS = (ConfigError, DynamicsError, FlyError, PolicyFileError, PolicyRateError)
