"""The vehicle profile against steps recorded on a real PX4 v1.17 (SIH quadrotor), and the tool that compares them."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import pytest

from sim_gateway.step_recordings import StepRecordingError, load_step, load_steps
from sim_gateway.step_response import RMS_TARGET, T63_TARGET, fit_all, fit_step, recorded, simulate
from sim_gateway.vehicle_params import IRIS, SIH_QUADX

STEPS = Path(__file__).parents[1] / "data" / "px4_steps"
FORWARD = STEPS / "vx_0_1_rep1.csv"


@pytest.fixture(scope="module")
def fits():
    return {fit.name: fit for fit in fit_all([STEPS], SIH_QUADX)}


def test_every_recorded_step_is_flown_within_the_targets(fits):
    assert len(fits) == 7
    for fit in fits.values():
        assert fit.rms_m_s <= RMS_TARGET, fit
        assert abs(fit.t63_off) <= T63_TARGET, fit


def test_shape_of_the_response_is_the_recorded_one(fits):
    for fit in fits.values():
        assert fit.simulated.final == pytest.approx(fit.recorded.final, abs=0.12), fit.name
        assert fit.simulated.dead_time_s == pytest.approx(fit.recorded.dead_time_s, abs=0.08), fit.name
        assert fit.simulated.peak_tilt_rad == pytest.approx(fit.recorded.peak_tilt_rad, abs=0.03), fit.name


def test_another_vehicle_does_not_fit():
    fit = fit_step("vx_0_3", [load_step(STEPS / "vx_0_3_rep1.csv")], IRIS)
    assert fit.rms_m_s > 2.0 * RMS_TARGET
    assert not fit.ok


def test_without_the_estimators_errors_another_flight_comes_out():
    recording = load_step(FORWARD)
    real = recorded(recording)
    with_error, without = (simulate(recording, SIH_QUADX, replay_error=replay) for replay in (True, False))
    miss = [abs(flown.velocity - real.velocity).mean() for flown in (with_error, without)]
    assert miss[0] < 0.5 * miss[1]


def test_slower_yaw_torque_is_seen_in_the_yaw_steps():
    recording = load_step(STEPS / "yawrate_0_1.0_rep1.csv")
    quick = fit_step("yaw", [recording], dataclasses.replace(SIH_QUADX, yaw_torque_cutoff_hz=50.0))
    assert quick.t63_off < -0.05


def test_repetitions_are_grouped_by_step(tmp_path):
    for repetition in (1, 2):
        (tmp_path / f"vx_0_1_rep{repetition}.csv").write_bytes(FORWARD.read_bytes())
    steps = load_steps([tmp_path])
    assert {name: len(runs) for name, runs in steps.items()} == {"vx_0_1": 2}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("gt_vx", "gt_wx"), "no column gt_vx"),
        (lambda text: "\n".join(text.splitlines()[:20]), "too few"),
        (lambda text: text.replace(text.splitlines()[30].split(",")[0], "nan"), "not a finite number"),
        (lambda text: "\n".join([text.splitlines()[0], *reversed(text.splitlines()[1:])]), "t_s must grow"),
    ],
)
def test_a_bad_file_is_refused_and_named(tmp_path, change, message):
    bad = tmp_path / "vx_0_1_rep1.csv"
    bad.write_text(change(FORWARD.read_text()))
    with pytest.raises(StepRecordingError, match=message) as error:
        load_step(bad)
    assert "vx_0_1_rep1.csv" in str(error.value)


def test_nothing_to_read_is_refused(tmp_path):
    with pytest.raises(StepRecordingError, match="no CSV file"):
        load_steps([tmp_path])


def command(*arguments):
    call = [sys.executable, "-m", "sim_gateway.step_fit", *map(str, arguments)]
    return subprocess.run(call, capture_output=True, text=True, timeout=120, check=False)


def test_command_prints_json_and_judges_by_its_exit_code(tmp_path):
    good = command(STEPS / "vx_0_3_rep1.csv", "--json")
    assert good.returncode == 0, good.stderr
    assert json.loads(good.stdout)["steps"][0]["name"] == "vx_0_3"
    bad = command(STEPS / "vx_0_3_rep1.csv", "--vehicle", "iris")
    assert bad.returncode == 1
    assert "NO" in bad.stdout
    assert command(tmp_path).returncode == 2
    assert command(FORWARD, "--vehicle", "tank").returncode == 2
