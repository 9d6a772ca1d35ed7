"""The fault catalogue as data: what is injected, what must follow, within which time, and how that is judged.

The ids are used all over the project (docs/safety.md, Codes). Bounds count from the first faulty sample at the computer to the
setpoint sent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum

from campaigns.faults import injectors
from campaigns.faults.scenes import FLIGHT_SCENES
from campaigns.faults.stage import Stage
from sim_gateway.faults import KINDS, MOTION, REPORT, SCAN, Fault


class Reaction(StrEnum):
    """What must follow a fault. Under every one of them: no contact, and the whole vehicle stays inside the fence."""

    BRAKE = "brake"  # zero setpoints from the bound on, for as long as `window_s`
    HOLD = "hold"  # as BRAKE, and fly commands Hold, then Land
    YIELD = "yield"  # no setpoint and no mode command from the bound on
    STOP = "stop"  # the stream ends; PX4's own loss action has the vehicle
    AWAY = "away"  # no part of a setpoint leads ahead, towards what is there
    FLY = "fly"  # no effect: no fault is named, the flight goes on
    SAFE = "safe"  # nothing but what holds under every one
    REFUSE = "refuse"  # never in OFFBOARD, no moving setpoint
    GROUND = "refused on the ground"  # see `ground`


@dataclass(frozen=True, slots=True)
class Expected:
    """`rules`: one of them must be named. `window_s`: how long it must last after `felt`. `fence`, `contacts`: still demanded."""

    reaction: Reaction
    bound_s: float = 0.0
    rules: tuple[str, ...] = ()
    window_s: float = 2.9
    fence: bool = True
    contacts: bool = True


@dataclass(frozen=True, slots=True)
class Entry:
    """One fault. `faults`: of the gateway, times from the fault's begin. `inject`: of the computer, the policy, the process.

    `felt`: with what it comes to the computer: a message's name, `scan`, `tick`, or by itself (see `felt_with`).
    `felt_after_s`: from the begin until it can be felt at all. `scenes`: where something else is expected. `note`: why.
    """

    id: str
    title: str
    expected: Expected
    faults: tuple[Fault, ...] = ()
    inject: Callable[[Stage], None] | None = None
    felt: str = ""
    felt_after_s: float = 0.0
    scenes: dict[str, Expected] = field(default_factory=dict)
    note: str = ""

    def expects(self, scene: str) -> Expected:
        """What must follow in this scene."""
        return self.scenes.get(scene, self.expected)

    @property
    def felt_with(self) -> str:
        """What brings the first faulty sample; empty where something stays away, which nothing brings."""
        if self.felt or not self.faults:
            return self.felt
        kind = self.faults[0].kind
        return _CARRIERS.get(kind, _GROUP_CARRIERS.get(KINDS[kind].group, ""))


_GROUP_CARRIERS = {SCAN: "scan", MOTION: "LOCAL_POSITION_NED", REPORT: "LOCAL_POSITION_NED"}
_CARRIERS = {
    **dict.fromkeys(("lidar_silent", "lidar_freeze_old", "lidar_beams", "lidar_slow", "lidar_delay", "lidar_clock"), ""),
    **dict.fromkeys(("report_stale", "report_nan", "report_attitude", "report_silent"), ""),
    "report_reset": "ODOMETRY",
    "report_invalid": "ESTIMATOR_STATUS",
    "report_landed": "EXTENDED_SYS_STATE",
    "battery": "SYS_STATUS",
    "pilot_mode": "CURRENT_MODE",
    "pilot_sticks": "",
    "px4_failsafe": "CURRENT_MODE",
}


LASTS_S = 3.0
TICK_S = 0.1  # one tick of the catalogue, phase included
SAFE = Expected(Reaction.SAFE)
FLY = Expected(Reaction.FLY)
STALE_S = 0.3  # limit of 200 ms, one sample period of 20 ms and its way, one tick


def _brake(bound_s: float, *rules: str, window_s: float = 2.9) -> Expected:
    return Expected(Reaction.BRAKE, bound_s, rules, window_s)


def _hold(bound_s: float, *rules: str) -> Expected:
    return Expected(Reaction.HOLD, bound_s, rules)


def _yield(bound_s: float, *, fence: bool = True, contacts: bool = True) -> Expected:
    return Expected(Reaction.YIELD, bound_s, fence=fence, contacts=contacts)


def _lasting(kind: str, duration_s: float = LASTS_S, **parameters: float) -> tuple[Fault, ...]:
    return (Fault(kind=kind, duration_s=duration_s, parameters=parameters),)


def _once(kind: str, **parameters: float) -> tuple[Fault, ...]:
    return (Fault(kind=kind, parameters=parameters),)


def _only(expected: Expected, *scenes: str) -> dict[str, Expected]:
    """`expected` everywhere but in `scenes`."""
    return {name: expected for name in FLIGHT_SCENES if name not in scenes}


def _in(expected: Expected, *scenes: str) -> dict[str, Expected]:
    return dict.fromkeys(scenes, expected)


_SLOW = "seen only in motion of 0.3 m/s or more"
_FROM_THE_START = "before OFFBOARD nothing tells a blind scanner from open space: residual risk"
_LIDAR = (
    Entry("L1", "no scan", _brake(0.3, "scan_stale", "scan_missing"), _lasting("lidar_silent")),
    Entry("L2", "frozen scan, fresh stamps", _brake(0.4, "scan_frozen"), _lasting("lidar_freeze"),
          scenes=_in(SAFE, "hover", "engage", "braking"), note=_SLOW),
    Entry("L3", "frozen scan, old stamps", _brake(0.3, "scan_stale"), _lasting("lidar_freeze_old")),
    Entry("L4", "nothing seen in any beam", _brake(0.25, "scan_blank"), _lasting("lidar_max"),
          scenes=_in(SAFE, "engage"), note=_FROM_THE_START),
    Entry("L5", "every beam too near", _brake(TICK_S, "scan_touching"), _lasting("lidar_min")),
    Entry("L6", "NaN in all beams", _brake(TICK_S, "scan_unknown"), _lasting("lidar_nan")),
    Entry("L7", "overflow, 65535 in all beams", _brake(TICK_S, "scan_blank", "scan_unknown"), _lasting("lidar_value"),
          scenes=_in(SAFE, "engage"), note=_FROM_THE_START),
    Entry("L8", "wrong beam count", _brake(0.3, "scan_stale", "scan_missing", "scan_source"), _lasting("lidar_beams")),
    Entry("L9", "mirrored scan", SAFE, _lasting("lidar_mirror"), scenes=_in(_hold(1.5, "scan_mirrored"), "yawing"),
          note="seen only while the vehicle turns"),
    Entry("L10", "device clock ahead by 0.5 s", SAFE, _lasting("lidar_clock", 9.0, offset_s=0.5),
          note="a stamp is never taken for later than its arrival: the scans keep their age"),
    Entry("L11", "device clock behind by 0.5 s", _brake(0.3, "scan_stale"), _lasting("lidar_clock", offset_s=-0.5)),
    Entry("L12", "phantom obstacle 0.6 m ahead", Expected(Reaction.AWAY, TICK_S, window_s=0.35),
          _lasting("lidar_phantom", distance_m=0.6), scenes=_in(SAFE, "engage", "hover", "yawing", "braking"),
          note="slower than 0.5 m/s there is room to stop before it"),
    Entry("L13", "what is there vanishes for 0.1 s", SAFE, _lasting("lidar_vanish", 0.1)),
    Entry("L14", "random near returns in 5 % of the beams", SAFE, _lasting("lidar_speckle")),
    Entry("L15", "a sector is blocked at 0.12 m", SAFE, _lasting("lidar_blocked")),
    Entry("L16", "a third of the rate", SAFE, _lasting("lidar_slow", every=3.0),
          note="older scans lower the speed cap, which 1 m/s does not reach"),
    Entry("L18", "a second publisher", _brake(TICK_S, "scan_source", "scan_backwards", "scan_stale"),
          inject=injectors.second_scanner, felt="tick"),
)  # fmt: skip
_BETWEEN = "what changes between anchoring on the ground and the loop is not compared: residual risk"
_ESTIMATE = (
    Entry("E1", "position jumps by 1 m and back", _brake(TICK_S, "estimate_jump", "estimate_jump_again"),
          _lasting("estimate_jump", 0.6), scenes=_in(SAFE, "engage"), note="over before the loop begins, in scene engage"),
    Entry("E2", "frozen odometry, fresh stamps", _brake(0.35, "estimate_frozen"), _lasting("report_freeze"),
          scenes=_in(SAFE, "hover", "braking"), note="seen only while 0.3 m/s or more is commanded"),
    Entry("E3", "stale odometry", _brake(STALE_S, "state_stale"), _lasting("report_stale")),
    Entry("E4", "NaN in the position", _brake(STALE_S, "state_stale"), _lasting("report_nan"),
          note="a message with NaN is dropped: it is a stale estimate"),
    Entry("E5", "drift of 0.2 m/s, accuracy told", Expected(Reaction.HOLD, 1.5, ("estimate_inaccurate",), fence=False),
          _lasting("estimate_drift", 12.0, y_m_s=0.2), felt_after_s=4.0,
          note="felt when the accuracy told (at 1 Hz) exceeds 1 m; drift beyond A4 presses through the fence: residual risk"),
    Entry("E6", "velocity is not that of the position", _brake(0.4, "velocity_mismatch"), _lasting("report_velocity")),
    Entry("E7", "yaw off by 90 degrees", SAFE, _lasting("estimate_yaw"),
          scenes=_in(_hold(1.5), "wall", "corner", "engage"), note="seen only in motion"),
    Entry("E8", "estimator reset, origin moved", _hold(TICK_S, "estimate_reset", "estimate_jump"), _once("report_reset"),
          scenes=_in(SAFE, "engage"), note=_BETWEEN),
    Entry("E9", "altitude jumps by 1 m", _hold(TICK_S, "altitude_jump"), _lasting("estimate_jump", y_m=0.0, z_m=1.0),
          scenes=_in(SAFE, "engage"), note=_BETWEEN),
    Entry("E10", "attitude is no rotation", _brake(STALE_S, "state_stale", "state_not_finite"), _lasting("report_attitude")),
    Entry("E11", "estimator says velocity invalid", _hold(0.2, "estimate_invalid"), _lasting("report_invalid", 9.0)),
)  # fmt: skip
_LINK = (
    Entry("K1", "downlink lost", _brake(STALE_S, "state_stale"), _lasting("link_down")),
    Entry("K2", "uplink lost", Expected(Reaction.STOP, 0.7), _lasting("link_up")),
    Entry("K3", "both ways dead for 0.4 s of every 1.5 s", _brake(STALE_S, "state_stale", window_s=1.3),
          _lasting("link_burst", burst_s=0.4, period_s=1.5), scenes=_in(SAFE, "engage"), note="until a healthy second is over"),
    Entry("K4", "0.3 s more delay, both ways", _hold(1.0, "link_slow", "state_stale"), _lasting("link_delay", 9.0)),
    Entry("K5", "duplicates and reordering", FLY, (*_lasting("link_duplicate"), *_lasting("link_reorder"))),
    Entry("K6", "another program sends setpoints", _hold(1.0, "foreign_setpoint"),
          _lasting("rogue", 9.0, y_m_s=0.5, rate_hz=31.0)),
    Entry("K7", "a second vehicle with the same ids", _yield(TICK_S), _lasting("link_foreign")),
    Entry("K8", "malformed messages", FLY, _lasting("link_garbage")),
    Entry("K9", "flood of 10,000 messages/s", FLY, _lasting("link_flood")),
    Entry("K10", "autopilot restarts", _yield(1.1, fence=False), _once("reboot"), note="its motors stop: it falls"),
    Entry("K11", "boot time jumps back by 20 s", _yield(TICK_S), _lasting("report_clock")),
)  # fmt: skip
_POLICY = (
    Entry("P1", "NaN action", _hold(TICK_S, "command_missing", "command_not_finite", "command_bad_again"),
          inject=injectors.policy_not_finite, felt="tick"),
    Entry("P2", "saturated action", SAFE, inject=injectors.policy_saturated, felt="tick"),
    Entry("P3", "action that aims at the nearest obstacle", SAFE, inject=injectors.policy_aims, felt="tick"),
    Entry("P4", "NaN in the hidden state", _brake(TICK_S, "command_missing", window_s=0.9),
          inject=injectors.hidden_not_finite, felt="tick", scenes=_in(SAFE, "engage"), note="OFFBOARD begins with a zero state"),
    Entry("P5", "hidden state explodes", _brake(TICK_S, "hidden_exploded"), inject=injectors.hidden_explodes, felt="tick"),
    Entry("P6", "inference takes 40 ms once", SAFE, inject=injectors.inference_late, felt="tick",
          note="the delay lowers the speed cap, which 1 m/s does not reach"),
    Entry("P7", "inference hangs for 2 s", _brake(0.2, window_s=1.9), inject=injectors.inference_hangs, felt="tick"),
    Entry("P9", "the same observation again and again", _brake(0.3, "scan_stale"), inject=injectors.old_observation),
    Entry("P10", "action alternates at every tick", SAFE, inject=injectors.policy_alternates, felt="tick"),
    Entry("P11", "observation far from what was trained", SAFE, _lasting("lidar_noise", sigma_m=1.0),
          note="no score of distance from training: the filter alone keeps it safe"),
)  # fmt: skip
_COMPUTER = (
    Entry("C1", "SIGKILL of the control process", _brake(0.15), inject=injectors.process_dies,
          note="the guard's state machine goes on; as processes: the process-death matrix"),
    Entry("C4", "SIGSTOP for 2.5 s, SIGCONT", _brake(0.15), inject=injectors.process_stopped),
    Entry("C5", "SIGTERM", _hold(TICK_S), inject=injectors.signalled, scenes=_in(_hold(1.5), "engage"),
          note="the handshake of a second is finished first"),
    Entry("C6", "unforeseen exception in the loop", _hold(TICK_S), inject=injectors.policy_raises, felt="tick",
          scenes=_in(_hold(1.5), "engage")),
    Entry("C7", "interpreter held for 0.25 s", _brake(0.15, window_s=0.29), inject=injectors.interpreter_held,
          scenes=_in(SAFE, "engage")),
    Entry("C8", "every wake-up 60 to 120 ms late", _hold(0.5), inject=injectors.starved),
    Entry("C10", "disk full", FLY, inject=injectors.disk_full),
    Entry("C11", "wall clock jumps by an hour", FLY, inject=injectors.wall_clock_jumps),
    Entry("C12", "computing takes 70 ms instead of some", _brake(0.2, "inference_hung", "loop_late"),
          inject=injectors.slow_computer, felt="tick"),
)  # fmt: skip
_VEHICLE = (
    Entry("V1", "pilot switches to Position", _yield(TICK_S), _once("pilot_mode", main=3.0, sub=0.0)),
    Entry("V2", "pilot moves the sticks", _yield(0.15, fence=False, contacts=False), _lasting("pilot_sticks", right=0.4),
          felt_after_s=0.5, note="where the pilot flies is the pilot's"),
    Entry("V3", "kill switch", _yield(1.1, fence=False), _once("disarm"), note="its motors stop: it falls"),
    Entry("V4", "PX4's own failsafe", _yield(TICK_S, fence=False), _once("px4_failsafe"),
          note="PX4 climbs to its own return height"),
    Entry("V5", "OFFBOARD refused", FLY, _lasting("refuse_offboard", 9.0),
          scenes=_in(Expected(Reaction.REFUSE), "engage"), note="matters only before OFFBOARD"),
    Entry("V6", "battery down to 12 %", _hold(1.0, "battery_low"), _once("battery", fraction=0.12)),
    Entry("V7", "velocity loop at 60 % of its gain", SAFE, _lasting("sluggish", 9.0, share=0.6)),
    Entry("V8", "gust of 3 m/s for 3 s", SAFE, _lasting("gust", x_m_s=3.0), note="inside the wind assumed in A1"),
    Entry("V9", "landed while the policy flies", _yield(0.3), _lasting("report_landed"), scenes=_in(_yield(1.6), "engage"),
          note="in the handshake, when OFFBOARD begins"),
    Entry("V10", "speed not reached: six times the drag", FLY, _lasting("heavy")),
)  # fmt: skip

IN_FLIGHT: tuple[Entry, ...] = (*_LIDAR, *_ESTIMATE, *_LINK, *_POLICY, *_COMPUTER, *_VEHICLE)
ELSEWHERE: dict[str, str] = {
    "L17": "glass, black or thin things return no beam: documented residual risk",
    "C2": "process-death matrix (python -m campaigns.process_death)",
    "C3": "process-death matrix (python -m campaigns.process_death)",
    "C9": "memory limit: an hour of ticks (python -m benchmarks memory)",
    "C13": "leak of descriptors or threads: an hour of ticks (python -m benchmarks memory)",
}
