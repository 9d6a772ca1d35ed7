"""Pilot first, against every order of events: after a mode that `fly` did not command, not one setpoint and not one mode command.

Whole engagements (arm, take off, OFFBOARD, brake, Hold, Land) through the real session, link and gateway. What `fly` sent is
counted on the vehicle's side of the wire, from the instant at which the vehicle itself changed its mode.
"""

from __future__ import annotations

import gc
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from air import Air, open_air, quiet

from flight.authority import Authority, ControlLostError
from flight.errors import VehicleCommandError
from flight.lidar.driver import LidarDriver
from flight.offboard import Ending, OffboardFlight
from flight.px4 import FlightMode
from flight.session import FlightSession
from flight.telemetry import Telemetry
from flight.tick import Pilot
from policy_export.runner import PolicyRunner
from safety.filter import SafetyFilter
from safety.frames import CorridorFrame, CorridorVector, NedVector
from safety.messages import LidarScan, SafeCommand

pytestmark = pytest.mark.realtime

ON_THE_WAY_S = 0.15
"""One tick of 50 ms, the way there and back, and a busy machine."""

DISARM_S = 1.3
"""Disarming shows in the heartbeat only: 1 Hz (safety notes V1, V3)."""

WATCH_S = 1.0
QUICK_TAKEOFF = {
    "COM_SPOOLUP_TIME": 0.0,
    "MPC_TKO_RAMP_T": 0.2,
    "MPC_TKO_SPEED": 2.0,
    "COM_RC_OVERRIDE": 3,
    "COM_OBL_RC_ACT": 5,
    "COM_OF_LOSS_T": 0.5,
}
FRAME = CorridorFrame(NedVector(-1.0, 0.0, 0.0), 0.0)
HOLD, LOITER = (4, 3), "AUTO.LOITER"


@pytest.fixture(scope="module")
def air(tmp_path_factory: pytest.TempPathFactory, seeker_policy: Path) -> Iterator[Air]:
    with open_air(tmp_path_factory.mktemp("air"), seeker_policy, QUICK_TAKEOFF) as air:
        yield air


@pytest.fixture(autouse=True)
def no_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    """The flight's full collection before the loop (30 ms on its own) takes a second here, where trainer and simulator share its
    heap, and the vehicle in this process would stand still meanwhile."""
    for name in ("collect", "freeze", "unfreeze"):
        monkeypatch.setattr(gc, name, lambda: 0)


@dataclass
class Flown:
    """One engagement and what came over the wire. `taken_s`: vehicle time of the takeover."""

    ending: Ending
    landed: bool
    taken_s: float
    late: list[tuple[float, str]]
    modes: list[str]


Story = Callable[[Air], None]


def engagement(air: Air, story: Story, *, grace_s: float = ON_THE_WAY_S) -> Flown:
    """Fly while `story` plays the pilot; `story` returns when the vehicle has been taken over."""
    air.put_back()
    mission = air.mission
    policy = PolicyRunner.load(mission.policy.path)
    pilot = Pilot(policy, SafetyFilter(mission.safety), CorridorVector(10.0, -0.4, 1.2), 0.3)
    status, interrupt = quiet()
    flight = OffboardFlight(air.link, air.lidar, pilot, FRAME, mission, interrupt, status)
    session = FlightSession(mission, air.path.parent, status, interrupt)
    taken: list[float] = []
    events = len(air.gateway.recorder.events)
    errors: list[BaseException] = []

    def play() -> None:
        try:
            story(air)
            taken.append(takeover_s(air, events))
        except BaseException as error:  # noqa: BLE001  (re-raised in the test's own thread)
            errors.append(error)

    player = threading.Thread(target=play, daemon=True)
    player.start()
    ending, landed = session._fly(air.link, flight, FRAME)
    player.join(20.0)
    if errors:
        raise errors[0]
    time.sleep(WATCH_S)
    modes = [str(event["mode"]) for event in air.gateway.recorder.events[events:]]
    return Flown(ending, landed, taken[0], air.received(taken[0] + grace_s), modes)


def takeover_s(air: Air, events: int) -> float:
    """Vehicle time of the first event that `fly` did not cause: the story notes it by `mark`."""
    found = _MARKS.pop("taken", None)
    assert found is not None, "the story did not say when the vehicle was taken"
    assert len(air.gateway.recorder.events) >= events
    return found


_MARKS: dict[str, float] = {}


def take(air: Air, act: Callable[[], None], done: Callable[[], bool]) -> None:
    """Act as the pilot until the vehicle has followed; notes the vehicle time."""
    act()
    air.wait(done, 5.0)
    _MARKS["taken"] = air.gateway.vehicle.time_s


def mode_is(air: Air, name: str) -> Callable[[], bool]:
    return lambda: air.autopilot.mode.px4_name == name


def setpoints(air: Air) -> int:
    return sum("SET_POSITION" in what for _, what in air.received())


def in_offboard(air: Air, for_s: float = 0.4) -> None:
    air.wait(mode_is(air, "OFFBOARD"), 20.0)
    started_s = air.gateway.vehicle.time_s
    air.wait(lambda: air.gateway.vehicle.time_s > started_s + for_s)


# ---- the pilot's stories


def while_arming_to_takeoff(air: Air) -> None:
    air.wait(lambda: air.autopilot.armed)
    take(air, lambda: air.station.mode(*HOLD[:1], 5), mode_is(air, "AUTO.RTL"))


def during_takeoff(air: Air) -> None:
    air.wait(mode_is(air, "AUTO.TAKEOFF"))
    take(air, lambda: air.station.mode(4, 6), mode_is(air, "AUTO.LAND"))


def during_the_first_setpoints(air: Air) -> None:
    """The stream has begun, OFFBOARD is not commanded yet."""
    before = setpoints(air)
    air.wait(lambda: setpoints(air) > before + 5, 20.0)
    assert air.autopilot.mode.px4_name == LOITER
    take(air, lambda: air.station.mode(4, 5), mode_is(air, "AUTO.RTL"))


def as_soon_as_engaged(air: Air) -> None:
    air.wait(mode_is(air, "OFFBOARD"), 20.0)
    take(air, lambda: air.station.mode(*HOLD), mode_is(air, LOITER))


def by_mode_in_flight(air: Air) -> None:
    in_offboard(air)
    take(air, lambda: air.station.mode(*HOLD), mode_is(air, LOITER))


def by_sticks(air: Air) -> None:
    """A joystick at 25 Hz, centred, then full forward: PX4 goes to Position by itself (override.json)."""
    in_offboard(air)
    for _ in range(8):
        air.station.sticks()
        time.sleep(0.04)
    assert air.autopilot.mode.px4_name == "OFFBOARD", "centred sticks do not take over"
    air.station.sticks(ahead=0.4)
    air.wait(mode_is(air, "POSCTL"), 2.0)
    _MARKS["taken"] = air.gateway.vehicle.time_s
    for _ in range(30):
        air.station.sticks()
        time.sleep(0.04)


def two_changes_in_a_row(air: Air) -> None:
    in_offboard(air)
    take(air, lambda: air.station.mode(4, 5), mode_is(air, "AUTO.RTL"))
    air.station.mode(4, 6)
    air.wait(mode_is(air, "AUTO.LAND"))


def back_to_offboard_at_once(air: Air) -> None:
    """Hold and OFFBOARD again within one tick: the mode of the moment says OFFBOARD, and still it is not ours."""
    in_offboard(air)
    seen = len(air.gateway.recorder.events)
    air.station.mode(*HOLD)
    time.sleep(0.012)  # PX4 reports a change when its link's turn comes; what it does not report, nobody can know
    air.station.mode(6)
    air.wait(lambda: [event["mode"] for event in air.gateway.recorder.events[seen:]][:2] == [LOITER, "OFFBOARD"])
    _MARKS["taken"] = air.gateway.vehicle.time_s


def back_to_offboard_later(air: Air) -> None:
    by_mode_in_flight(air)
    taken = _MARKS["taken"]
    time.sleep(0.3)
    air.station.mode(6)
    time.sleep(0.3)
    _MARKS["taken"] = taken


def while_braking_at_the_end(air: Air) -> None:
    """The goal is reached (here: the flight is stopped by its own judge); the brake has begun."""
    in_offboard(air, 0.3)
    air.wait(_BRAKING.is_set, 20.0)
    time.sleep(0.1)
    take(air, lambda: air.station.mode(4, 5), mode_is(air, "AUTO.RTL"))


def after_hold_before_landing(air: Air) -> None:
    """Hold was commanded by `fly`; the pilot is in Return before Land is."""
    in_offboard(air, 0.3)
    air.wait(mode_is(air, LOITER), 20.0)
    take(air, lambda: air.station.mode(4, 5), mode_is(air, "AUTO.RTL"))


def while_landing(air: Air) -> None:
    in_offboard(air, 0.3)
    air.wait(mode_is(air, "AUTO.LAND"), 20.0)
    time.sleep(0.2)
    take(air, lambda: air.station.mode(*HOLD), mode_is(air, LOITER))


def by_disarming(air: Air) -> None:
    in_offboard(air)
    take(air, lambda: air.station.command(400, 0, 21196), lambda: not air.autopilot.armed)


def px4_failsafe(air: Air) -> None:
    """The pilot's transmitter is lost: PX4's own failsafe takes Hold; `fly` does not fight it."""
    in_offboard(air)
    for _ in range(5):
        air.station.sticks()
        time.sleep(0.04)
    air.wait(lambda: air.autopilot.failsafe, 3.0)
    _MARKS["taken"] = air.gateway.vehicle.time_s


_BRAKING = threading.Event()
_HANGS = threading.Event()
HANG_S = 1.5
TAKEOVERS: tuple[Story, ...] = (
    while_arming_to_takeoff,
    during_takeoff,
    during_the_first_setpoints,
    as_soon_as_engaged,
    by_mode_in_flight,
    by_sticks,
    two_changes_in_a_row,
    back_to_offboard_at_once,
    back_to_offboard_later,
    px4_failsafe,
)


@pytest.mark.parametrize("story", TAKEOVERS, ids=lambda story: story.__name__)
def test_after_a_takeover_nothing_is_sent(air: Air, story: Story) -> None:
    flown = engagement(air, story)
    assert flown.late == []
    assert flown.ending.outcome == "pilot_took_over", flown
    assert flown.ending.in_control is False
    assert flown.landed is False
    assert air.link.authority is not None
    assert air.link.authority.lost is not None


def test_after_disarming_in_flight_nothing_is_sent(air: Air) -> None:
    """A kill shows in the heartbeat, once a second: setpoints end with it, and nothing arms again."""
    flown = engagement(air, by_disarming, grace_s=DISARM_S)
    assert flown.late == []
    assert flown.ending.outcome in ("disarmed", "landed_in_flight"), flown  # it falls: the ground may come first
    assert air.autopilot.armed is False
    assert "ARM_DISARM" not in [what for _, what in air.received(flown.taken_s)]


@pytest.fixture
def stopping(monkeypatch: pytest.MonkeyPatch) -> None:
    """End the flight after 0.3 s by its own time limit, and tell when the brake begins."""
    run, brake = OffboardFlight.run, OffboardFlight.brake
    _BRAKING.clear()

    def short(self: OffboardFlight) -> Ending:
        self._judge._timeouts = self._judge._timeouts.model_copy(update={"flight_s": 0.6})
        return run(self)

    def told(self: OffboardFlight, duration_s: float) -> None:
        _BRAKING.set()
        brake(self, duration_s)

    monkeypatch.setattr(OffboardFlight, "run", short)
    monkeypatch.setattr(OffboardFlight, "brake", told)


@pytest.mark.parametrize(
    "story", [while_braking_at_the_end, after_hold_before_landing, while_landing], ids=lambda story: story.__name__
)
@pytest.mark.usefixtures("stopping")
def test_a_takeover_during_the_ending_stops_the_ending(air: Air, story: Story) -> None:
    """Brake, Hold and Land are commands as well: none is sent any more."""
    flown = engagement(air, story)
    assert flown.late == []
    assert flown.landed is False
    assert flown.modes[-1] in ("AUTO.RTL", LOITER)


@pytest.mark.usefixtures("stopping")
def test_undisturbed_it_holds_and_lands(air: Air) -> None:
    def nobody(air: Air) -> None:
        in_offboard(air, 0.1)
        _MARKS["taken"] = math.inf

    flown = engagement(air, nobody)
    assert flown.landed is True, flown
    assert [mode for mode in flown.modes if mode in ("OFFBOARD", "AUTO.LAND")] == ["OFFBOARD", "AUTO.LAND"]


@pytest.fixture
def hanging(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop hangs for a while once `_HANGS` is set."""
    latest = LidarDriver.latest
    _HANGS.clear()

    def slow(self: LidarDriver) -> LidarScan | None:
        if _HANGS.is_set():
            _HANGS.clear()
            time.sleep(HANG_S)
        return latest(self)

    monkeypatch.setattr(LidarDriver, "latest", slow)


@pytest.mark.parametrize("delay_s", [0.0, 0.3], ids=["before the guard brakes", "while the guard brakes"])
@pytest.mark.usefixtures("hanging")
def test_a_takeover_while_the_loop_hangs_is_not_followed_by_braking(air: Air, delay_s: float) -> None:
    def story(air: Air) -> None:
        in_offboard(air)
        _HANGS.set()
        time.sleep(delay_s)
        take(air, lambda: air.station.mode(*HOLD), mode_is(air, LOITER))

    flown = engagement(air, story)
    assert flown.late == []
    assert flown.ending.outcome == "pilot_took_over", flown
    assert flown.ending.in_control is False


def test_the_full_garbage_collection_comes_before_offboard(air: Air, monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes up to 100 ms, in which no setpoint is sent: PX4 must not be waiting for one."""
    when: list[str] = []
    monkeypatch.setattr(gc, "collect", lambda: when.append(air.autopilot.mode.px4_name))
    engagement(air, as_soon_as_engaged)
    assert when
    assert "OFFBOARD" not in when


def test_the_link_refuses_everything_after_the_loss(air: Air) -> None:
    """The last gate: whoever still tries gets an error, and the wire stays empty."""
    air.put_back()
    air.link.authority = Authority(air.link.telemetry)
    air.station.mode(4, 6)
    air.link.wait_until(lambda: not air.link.in_control, 3.0)
    before = len(air.received())
    still = SafeCommand(CorridorVector(0.0, 0.0, 0.0), 0.0)
    for attempt in (
        lambda: air.link.send_velocity(still, FRAME),
        lambda: air.link.set_mode(FlightMode.HOLD),
        lambda: air.link.set_mode(FlightMode.OFFBOARD),
        air.link.arm,
        lambda: air.link.take_off(1.0),
    ):
        with pytest.raises(ControlLostError):
            attempt()
    time.sleep(0.3)
    assert len(air.received()) == before
    air.put_back()


# ---- the latch itself


def heard(telemetry: Telemetry, mode: FlightMode, armed: bool = True) -> None:
    custom = mode.main << 16 | mode.sub << 24
    base = 0x80 if armed else 0
    telemetry.feed("HEARTBEAT", 1, f'{{"autopilot":12,"base_mode":{base},"custom_mode":{custom}}}', 1.0)


def watching(mode: FlightMode = FlightMode.HOLD) -> tuple[Telemetry, Authority]:
    telemetry = Telemetry()
    heard(telemetry, mode)
    return telemetry, Authority(telemetry)


def test_commanded_modes_keep_control() -> None:
    telemetry, authority = watching()
    for mode in (FlightMode.TAKEOFF, FlightMode.HOLD, FlightMode.OFFBOARD, FlightMode.HOLD, FlightMode.LAND):
        if mode is not FlightMode.HOLD or telemetry.mode != FlightMode.TAKEOFF:
            authority.expect(mode)
        heard(telemetry, mode)
        assert authority.lost is None


@pytest.mark.parametrize("mode", [FlightMode.POSCTL, FlightMode.RTL, FlightMode.LAND, FlightMode.STABILIZED, FlightMode.OFFBOARD])
def test_any_other_mode_loses_it_for_good(mode: FlightMode) -> None:
    telemetry, authority = watching()
    heard(telemetry, mode)
    heard(telemetry, FlightMode.HOLD)
    assert authority.lost is not None
    assert authority.outcome == "pilot_took_over"
    with pytest.raises(ControlLostError):
        authority.expect(FlightMode.HOLD)


def test_a_change_between_two_looks_is_seen() -> None:
    telemetry, authority = watching()
    authority.expect(FlightMode.OFFBOARD)
    heard(telemetry, FlightMode.OFFBOARD)
    assert authority.lost is None
    heard(telemetry, FlightMode.POSCTL)
    heard(telemetry, FlightMode.OFFBOARD)
    assert telemetry.mode == FlightMode.OFFBOARD
    assert authority.lost is not None


def test_more_changes_than_are_kept_are_not_overlooked() -> None:
    telemetry, authority = watching()
    for _ in range(500):
        heard(telemetry, FlightMode.POSCTL)
        heard(telemetry, FlightMode.HOLD)
    assert authority.lost is not None


def test_a_mode_that_was_refused_and_comes_late_is_foreign() -> None:
    telemetry, authority = watching()
    authority.expect(FlightMode.OFFBOARD)
    authority.refused()
    heard(telemetry, FlightMode.OFFBOARD)
    assert authority.lost is not None


def test_disarming_loses_it_and_arming_again_does_not_bring_it_back() -> None:
    telemetry, authority = watching()
    assert authority.lost is None
    heard(telemetry, FlightMode.HOLD, armed=False)
    assert authority.lost is not None
    heard(telemetry, FlightMode.HOLD)
    assert authority.outcome == "disarmed"


def test_a_restart_of_the_autopilot_loses_it() -> None:
    telemetry, authority = watching()
    telemetry.clock.reboots += 1
    assert authority.lost is not None
    assert isinstance(ControlLostError("x"), VehicleCommandError)


def test_on_the_ground_in_offboard_loses_it() -> None:
    telemetry, authority = watching()
    telemetry.feed("EXTENDED_SYS_STATE", 1, '{"landed_state":1}', 1.0)
    assert authority.lost is None
    authority.expect(FlightMode.OFFBOARD)
    heard(telemetry, FlightMode.OFFBOARD)
    assert authority.lost is not None
    assert authority.outcome == "landed_in_flight"
