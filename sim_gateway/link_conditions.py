"""A link that is not perfect: messages late, lost or twice, both ways, the same for the same seed."""

from __future__ import annotations

import heapq
from typing import Any

import numpy as np

from sim_gateway.link_spec import LinkQuality

_KEPT = 50_000


class LinkConditions:
    """What a link of some quality makes of its messages. `in_order`: it carries a stream, in which none overtakes another."""

    def __init__(self, quality: LinkQuality, seed: int, *, in_order: bool = False) -> None:
        self._quality, self._in_order = quality, in_order
        self._ways = {way: _Way(np.random.Generator(np.random.PCG64([seed, number]))) for number, way in enumerate(("out", "in"))}

    def out(self, message: Any, now_s: float) -> list[Any]:
        """What leaves now, after one more message wants to."""
        self._put("out", message, now_s)
        return self.due_out(now_s)

    def due_out(self, now_s: float) -> list[Any]:
        """What leaves now."""
        return self._ways["out"].due(now_s)

    def into(self, arrived: list[Any], now_s: float) -> list[Any]:
        """What arrives now, after these have come over the wire."""
        for message in arrived:
            self._put("in", message, now_s)
        return self._ways["in"].due(now_s)

    def _put(self, name: str, message: Any, now_s: float) -> None:
        way, quality = self._ways[name], self._quality
        if quality.loss and way.generator.random() < quality.loss:
            return
        copies = 2 if quality.duplicate and way.generator.random() < quality.duplicate else 1
        for _ in range(copies):
            late_s = quality.delay_s
            if quality.jitter_s:
                late_s = max(0.0, late_s + quality.jitter_s * way.generator.uniform(-1.0, 1.0))
            way.keep(message, now_s + late_s, in_order=self._in_order)


class _Way:
    """Messages under way in one direction."""

    def __init__(self, generator: np.random.Generator) -> None:
        self.generator = generator
        self._late: list[tuple[float, int, Any]] = []
        self._count, self._last_s = 0, 0.0

    def keep(self, message: Any, due_s: float, *, in_order: bool) -> None:
        if len(self._late) >= _KEPT:
            return
        self._last_s = max(self._last_s, due_s) if in_order else due_s
        self._count += 1
        heapq.heappush(self._late, (self._last_s, self._count, message))

    def due(self, now_s: float) -> list[Any]:
        found = []
        while self._late and self._late[0][0] <= now_s + 1e-9:
            found.append(heapq.heappop(self._late)[2])
        return found
