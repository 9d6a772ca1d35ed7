"""Limits met exactly, and passed by the least there is: what a wrong comparison would get away with."""

from __future__ import annotations

from safety.frames import CorridorFrame, CorridorVector, NedVector


def test_frames_can_be_asked_through_an_object_too():
    frame = CorridorFrame(NedVector(3.0, 4.0, -1.0), 0.7)
    there, here = NedVector(1.0, -2.0, -3.0), CorridorVector(2.0, 1.0, 3.0)
    assert frame.anchored(there, here, 0.7) == CorridorFrame.anchored(there, here, 0.7)
    assert frame.yaw_rate_to_ned(0.25) == -0.25
