"""The real policy as an adversary: it flies well, then its signs are turned over."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from campaigns.adversaries.policies import Generator, Policy, View, command
from campaigns.adversaries.scenes import Scene
from campaigns.lockstep import Unfiltered
from flight.tick import Pilot
from policy_export.runner import PolicyRunner
from safety.frames import CorridorVector
from safety.messages import VelocityCommand

POLICY = Path("policies/corridor_ppo_lstm.onnx")
REACH_M = 12.0


@lru_cache(maxsize=1)
def _runner() -> PolicyRunner:
    return PolicyRunner.load(POLICY)


def flipped(scene: Scene, random: Generator) -> Policy:
    """The trained policy towards a random goal; every 0.5 to 3 s the signs of its command are drawn anew."""
    x, y, _ = scene.world.start
    goal = CorridorVector(x + random.uniform(-REACH_M, REACH_M), y + random.uniform(-REACH_M, REACH_M), 2.0)
    pilot = Pilot(_runner(), Unfiltered(scene.safety), goal, 0.2)
    pilot.reset()
    signs, hold = np.ones(4), int(random.integers(10, 60))

    def policy(view: View) -> VelocityCommand:
        assert view.state is not None
        wanted = pilot.tick(view.scan, view.state, view.state.time_s).wanted
        if view.tick % hold == hold - 1:
            signs[:] = random.choice((-1.0, 1.0), 4)
        if wanted is None:
            return command(0.0, 0.0, 0.0, 0.0)
        v = wanted.velocity
        return command(signs[0] * v.x, signs[1] * v.y, signs[2] * v.z, signs[3] * wanted.yaw_rate_rad_s)

    return policy
