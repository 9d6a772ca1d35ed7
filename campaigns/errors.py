"""What a user can get wrong, across all houses: each is reported in one line, without a traceback."""

from __future__ import annotations

from flight.errors import FlyError
from policy_export.errors import PolicyFileError, PolicyRateError
from strict_yaml import ConfigError

USER_ERRORS = (ConfigError, FlyError, PolicyFileError, PolicyRateError)
