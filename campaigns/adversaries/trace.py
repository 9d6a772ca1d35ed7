"""One flight as text and as a picture, for looking at what went wrong."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from campaigns.adversaries.flight import HULL_RADIUS_M, Outcome
from campaigns.adversaries.policies import View
from safety.messages import SafeCommand, Verdict


class Trace:
    """Keeps every tick it is shown."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._notes: list[str] = []
        self._view: View | None = None

    def watch(self, view: View, sent: SafeCommand, verdict: Verdict, outcome: Outcome) -> None:
        """One tick, before it is flown."""
        self._view, v = view, sent.velocity
        obstacle = float(np.hypot(*view.to_obstacle())) - HULL_RADIUS_M
        fence = float(np.hypot(*view.to_fence())) - HULL_RADIUS_M
        assert view.state is not None
        error = view.state.position.x - view.place[0], view.state.position.y - view.place[1]
        self._rows.append((view.tick * 0.05, *view.place, view.yaw_rad, *view.velocity, v.x, v.y, v.z, obstacle, fence, *error))
        rules = " ".join(f"{i.rule}={i.value:.2f}/{i.limit:.2f}" for i in verdict.interventions)
        self._notes.append(f"{verdict.fault or ''} {rules} {outcome.events or ''}")

    def lines(self) -> list[str]:
        """Time, place, yaw, velocity, sent, distance of the hull to obstacle and fence, estimate's error, rules."""
        head = "  t      x     y     z    yaw |    vx    vy    vz |    ux    uy    uz | obst. fence |   ex    ey"
        rows = [
            f"{t:5.2f} {x:6.2f} {y:6.2f} {z:5.2f} {yaw:6.2f} | {vx:5.2f} {vy:5.2f} {vz:5.2f} | {ux:5.2f} {uy:5.2f} {uz:5.2f} | "
            f"{min(o, 99.0):5.2f} {f:5.2f} | {ex:5.2f} {ey:5.2f} {note}"
            for (t, x, y, z, yaw, vx, vy, vz, ux, uy, uz, o, f, ex, ey), note in zip(self._rows, self._notes, strict=True)
        ]
        return [head, *rows]

    def picture(self, path: Path, title: str) -> None:
        """The way seen from above, with fence, boxes and the hull where it was nearest to trouble."""
        import matplotlib as mpl  # noqa: PLC0415  slow to import, and only here

        mpl.use("Agg")
        from matplotlib import pyplot as plt  # noqa: PLC0415
        from matplotlib.patches import Circle, Rectangle  # noqa: PLC0415

        assert self._view is not None
        scene, rows = self._view.scene, np.array(self._rows)
        figure, axes = plt.subplots(figsize=(8.0, 6.0), layout="constrained")
        for x0, y0, _, x1, y1, _ in self._view.boxes:
            axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, color="0.6"))
        for ring in (scene.fence.outer, *scene.fence.holes):
            closed = np.array((*ring, ring[0]))
            axes.plot(closed[:, 0], closed[:, 1], "r-", linewidth=1)
        axes.plot(rows[:, 1], rows[:, 2], "b-", linewidth=0.8)
        worst = rows[int(np.argmin(np.minimum(rows[:, 11], rows[:, 12])))]
        axes.add_patch(Circle((worst[1], worst[2]), HULL_RADIUS_M, fill=False, color="b"))
        axes.plot([worst[1], worst[1] + math.cos(worst[4])], [worst[2], worst[2] + math.sin(worst[4])], "b:", linewidth=0.8)
        low, high = scene.fence.corners.min(axis=0) - 1.0, scene.fence.corners.max(axis=0) + 1.0
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", title=f"{title}, nearest at {worst[0]:.2f} s")
        figure.savefig(path, dpi=90)
        plt.close(figure)
