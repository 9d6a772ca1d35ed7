"""Runs a policy file one step at a time. Needs numpy, onnxruntime and pydantic; never torch or onnx.

A step copies the observation into a bound buffer, runs the graph and checks the answer: nothing is allocated that grows. The
hidden state lives in two buffers that swap places, so that a step never writes what it reads.
"""

from __future__ import annotations

import math
from operator import le
from pathlib import Path

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors

from policy_export.contract import ActionLayout, ObservationLayout, PolicyMetadata, ResetReason, foreign_fields
from policy_export.errors import PolicyFileError, PolicyInputError, PolicyOutputError, PolicyRateError
from policy_export.policy_file import PolicyFile, read_policy_file

_WARM_UP_STEPS = 8
_LIMIT_SLACK = 1e-5
"""Rounding of the scaled tanh in float32, m/s or rad/s; relative for limits beyond those of any vehicle."""
_VELOCITY_BOUND = 50.0

_ORT_ERRORS = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
    ort_errors.EPFail,
    RuntimeError,
    ValueError,
    MemoryError,
)

FloatArray = NDArray[np.float32]


class PolicyRunner:
    """One policy with its hidden state, for one vehicle and one thread. Make it with `load`.

    `metadata` is what the file says, `sha256` the digest of its bytes, `step_count` the steps since the last reset.
    """

    def __init__(self, file: PolicyFile) -> None:
        """Compile and warm up a file that `read_policy_file` accepted; use `load` to also check that it can be honoured."""
        self.metadata: PolicyMetadata = file.metadata
        self.sha256 = file.sha256
        self.step_count = 0
        self.last_reset: str = "load"
        self._current = 0  # which of the two states the next step reads
        self._last_step_s: float | None = None
        action = file.metadata.action
        self._low = tuple(low - _slack(low) for low in action.low)
        self._high = tuple(high + _slack(high) for high in action.high)
        self._session = open_session(file.data)
        self._allocate(any(port.name == "value" for port in file.model.outputs))
        self._warm_up()

    @classmethod
    def load(
        cls,
        path: str | Path,
        rate_hz: float = 20.0,
        *,
        allow_other_rate: bool = False,
        expected_sha256: str | None = None,
        expected_observation: ObservationLayout | None = None,
        allowed_action: ActionLayout | None = None,
        allow_foreign: bool = False,
    ) -> PolicyRunner:
        """Load, judge and warm up a policy file; raises `PolicyFileError` naming the field, or `PolicyRateError`.

        `rate_hz`: the rate of the loop that will step it; another than the trained one is an error unless
        `allow_other_rate`. `expected_sha256`: digest of the file's bytes. `expected_observation`: the layout that the
        caller can build. `allowed_action`: frame and limits that the caller can honour; a file that may command more is
        refused. `allow_foreign`: accept observation channels and actions called `other...`, which `ObservationBuilder` cannot
        build and no vehicle flies; for a caller that knows what they mean.
        """
        file = read_policy_file(path)
        if expected_sha256 is not None and file.sha256 != expected_sha256.lower():
            raise PolicyFileError("sha256", f"the file has {file.sha256}, expected was {expected_sha256}")
        _check_rate(file.metadata, rate_hz, allow_other_rate)
        if not allow_foreign and (foreign := foreign_fields(file.metadata)):
            problem = "only a program made for this policy knows what it means (allow_foreign=True if this is one)"
            raise PolicyFileError(f"metadata.{foreign[0]}", problem)
        if expected_observation is not None:
            _check_observation(file.metadata.observation, expected_observation)
        if allowed_action is not None:
            _check_action(file.metadata.action, allowed_action)
        return cls(file)

    def reset(self, reason: ResetReason | str = "offboard_entry") -> None:
        """Zero the hidden state, as the file demands at OFFBOARD entry, goal change, policy change and after a gap."""
        self._states[self._current][:] = 0.0
        self.step_count = 0
        self.last_reset = reason
        self._last_step_s = None

    def step(self, observation: FloatArray, now_s: float | None = None) -> FloatArray:
        """One tick: observation float32 [size] to action float32 [4] (vx, vy, vz m/s, yaw rate rad/s; others: [action size]).

        The returned array is read-only and overwritten by the next step. With `now_s` (any monotonic clock) the runner
        itself applies the gap rule: more than `metadata.reset.max_gap_s` since the last step zeroes the state first.
        `PolicyInputError`: wrong shape, type or non-finite observation; the state is unchanged. `PolicyOutputError`:
        non-finite or out-of-limit output; the state has been reset.
        """
        if observation.shape != self._input.shape or observation.dtype != np.float32:
            wanted = f"float32 {self._input.shape}"
            raise PolicyInputError(f"observation must be {wanted}, not {observation.dtype} {observation.shape}")
        np.copyto(self._input, observation)
        # A dot product with itself is the cheapest test of all values: NaN and infinity both survive it.
        if not math.isfinite(self._input.dot(self._input)):
            raise PolicyInputError("observation holds NaN, infinity or a value beyond 1e19")
        if now_s is not None:
            self._apply_gap_rule(now_s)
        current = self._current
        self._session.run_with_iobinding(self._bindings[current])
        self._current = 1 - current
        self.step_count += 1
        self._check_output(self._outputs[current])
        return self._actions[current]

    @property
    def value(self) -> float:
        """The critic's estimate at the last step; NaN when the file has none."""
        return float(self._values[1 - self._current][0]) if self._has_value else math.nan

    @property
    def hidden_norm(self) -> float:
        """Euclidean norm of h; 0 without memory."""
        h = self._states[self._current][: self._state_size]
        return math.sqrt(float(h.dot(h)))

    @property
    def hidden_state(self) -> tuple[FloatArray, FloatArray]:
        """Copies of h and c [layers, H] that the next step will read."""
        size, shape = self._state_size, (self.metadata.layers, self.metadata.hidden_size)
        state = self._states[self._current]
        return state[:size].copy().reshape(shape), state[size:].copy().reshape(shape)

    @property
    def _state_size(self) -> int:
        return self.metadata.layers * self.metadata.hidden_size

    def _allocate(self, has_value: bool) -> None:
        """Per direction k: the step reads states[k] and writes states[1 - k]; [h | c | action | value] lie side by side."""
        size, width = self._state_size, self.metadata.action.size
        self._has_value = has_value
        self._input = np.zeros(self.metadata.observation.size, dtype=np.float32)
        blocks = [np.zeros(2 * size + width + 1, dtype=np.float32) for _ in range(2)]
        self._states = [block[: 2 * size] for block in blocks]
        self._outputs = [blocks[1], blocks[0]]
        self._actions = [block[2 * size : 2 * size + width] for block in self._outputs]
        self._values = [block[2 * size + width :] for block in self._outputs]
        self._bindings = [self._bind(k) for k in range(2)]
        for k in range(2):
            # Views handed out; onnxruntime writes through the bound pointer.
            self._actions[k] = self._actions[k].view()
            self._actions[k].flags.writeable = False

    def _bind(self, k: int) -> ort.IOBinding:
        binding = self._session.io_binding()
        size, shape = self._state_size, (self.metadata.layers, 1, self.metadata.hidden_size)
        source, target = self._states[k], self._states[1 - k]
        _bind_buffer(binding.bind_input, "obs", self._input, (1, self._input.size))
        _bind_buffer(binding.bind_output, "action", self._actions[k], (1, self._actions[k].size))
        if size:
            for name, part in (("h", slice(0, size)), ("c", slice(size, 2 * size))):
                _bind_buffer(binding.bind_input, f"{name}_in", source[part], shape)
                _bind_buffer(binding.bind_output, f"{name}_out", target[part], shape)
        if self._has_value:
            _bind_buffer(binding.bind_output, "value", self._values[k], (1,))
        return binding

    def _apply_gap_rule(self, now_s: float) -> None:
        last = self._last_step_s
        if last is not None and not 0.0 <= now_s - last <= self.metadata.reset.max_gap_s:
            self.reset("gap")
        self._last_step_s = now_s

    def _check_output(self, output: FloatArray) -> None:
        if not math.isfinite(output.dot(output)):
            self.reset("bad_output")
            raise PolicyOutputError("the policy answered with NaN or infinity; its hidden state was reset")
        values = self._actions[1 - self._current].tolist()
        if not (all(map(le, self._low, values)) and all(map(le, values, self._high))):
            self.reset("bad_output")
            raise PolicyOutputError(f"the policy answered outside its own limits ({values}); its hidden state was reset")

    def _warm_up(self) -> None:
        """First steps of a session allocate; take them here, on a plausible observation, and judge their answers."""
        lidar = self.metadata.observation.lidar
        probe = np.zeros_like(self._input)
        if (channel := self.metadata.observation.channel("lidar")) is not None:
            probe[channel.span] = lidar.range_max_m
        try:
            for _ in range(_WARM_UP_STEPS):
                self.step(probe)
        except PolicyOutputError as error:
            raise PolicyFileError("graph", f"fails its first steps: {error}") from None
        except _ORT_ERRORS as error:
            raise PolicyFileError("graph", f"onnxruntime cannot run it: {_one_line(error)}") from None
        self.reset("load")


def _slack(limit: float) -> float:
    return _LIMIT_SLACK * max(1.0, abs(limit) / _VELOCITY_BOUND)


def open_session(data: bytes) -> ort.InferenceSession:
    """An onnxruntime session on one thread that does not spin; raises `PolicyFileError` when the graph is not runnable."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = 4  # the error comes back as an exception; nothing is to be printed beside it
    try:
        return ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except _ORT_ERRORS as error:
        raise PolicyFileError("graph", f"onnxruntime refuses it: {_one_line(error)}") from None


def _bind_buffer(bind: object, name: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    """Bind by address, so that nothing is copied; the runner owns the arrays for as long as the binding lives."""
    assert callable(bind)
    assert array.flags.c_contiguous
    bind(name, "cpu", 0, np.float32, shape, array.ctypes.data)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:300]


def _check_rate(metadata: PolicyMetadata, rate_hz: float, allow_other_rate: bool) -> None:
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise PolicyRateError(f"the loop's rate must be a positive number, not {rate_hz}")
    if not allow_other_rate and not math.isclose(rate_hz, metadata.rate_hz, rel_tol=1e-6):
        message = f"rate_hz: the policy was trained at {metadata.rate_hz:g} Hz and would be stepped at {rate_hz:g} Hz"
        raise PolicyRateError(f"{message}; change the loop's rate, or pass allow_other_rate=True if you mean it")


def _check_observation(found: ObservationLayout, wanted: ObservationLayout) -> None:
    if found.lidar != wanted.lidar:
        raise PolicyFileError("metadata.observation.lidar", f"the policy wants {found.lidar}, this program gives {wanted.lidar}")
    if found != wanted:
        names = [f"{c.name}[{c.start}:{c.stop}] {c.frame}" for c in found.channels]
        raise PolicyFileError("metadata.observation.channels", f"this program cannot build the layout {', '.join(names)}")


def _check_action(found: ActionLayout, allowed: ActionLayout) -> None:
    if found.names != allowed.names:
        raise PolicyFileError(
            "metadata.action.names", f"are {', '.join(found.names)}, this program flies {', '.join(allowed.names)}"
        )
    if found.frame != allowed.frame:
        raise PolicyFileError("metadata.action.frame", f"is {found.frame}, this program flies {allowed.frame}")
    if any(f < a for f, a in zip(found.low, allowed.low, strict=True)):
        raise PolicyFileError("metadata.action.low", f"{found.low} goes beyond what is allowed here, {allowed.low}")
    if any(f > a for f, a in zip(found.high, allowed.high, strict=True)):
        raise PolicyFileError("metadata.action.high", f"{found.high} goes beyond what is allowed here, {allowed.high}")
