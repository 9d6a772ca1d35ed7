"""Step a policy file with numpy and onnxruntime alone: python fly_policy_file.py policy.onnx (docs/policy_file.md)."""

import json
import sys

import numpy as np
import onnxruntime as ort

session = ort.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
meta = json.loads(session.get_modelmeta().custom_metadata_map["lstm_pilot"])
assert meta["schema_version"] == 1
lidar, frame = meta["observation"]["lidar"], meta["action"]["frame"]
names = [port.name for port in session.get_outputs()]
shape = (meta["layers"], 1, meta["hidden_size"])
state = {name: np.zeros(shape, np.float32) for name in ("h_in", "c_in") if meta["hidden_size"]}  # so again after a reset


def step(ranges_m, goal_m, position_m, velocity, acceleration, yaw):
    """Everything in the corridor frame; the answer is in the frame that the file names."""
    far = np.minimum(ranges_m, lidar["range_max_m"])
    values = {"lidar": np.where(ranges_m < lidar["range_min_m"], 0.0, far), "yaw": np.array([yaw]), "position": position_m}
    values |= {"goal_offset": goal_m - position_m, "velocity": velocity, "acceleration": acceleration}
    cos, sin = np.cos(yaw), np.sin(yaw)
    to_heading = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    obs = [
        to_heading @ values[c["name"]] if c["frame"] == "heading" else values[c["name"]] for c in meta["observation"]["channels"]
    ]
    out = dict(zip(names, session.run(names, {"obs": np.concatenate(obs)[None].astype(np.float32), **state}), strict=True))
    state.update({name: out[name.replace("in", "out")] for name in state})
    return out["action"][0]


position, velocity, zero = np.zeros(3), np.array([0.5, 0.0, 0.0]), np.zeros(3)
for _ in range(3):  # at meta["rate_hz"]
    vx, vy, vz, yaw_rate = step(np.full(lidar["beams"], np.inf), np.array([25.0, 1.0, 0.0]), position, velocity, zero, 0.3)
    print(f"{vx:.4f} {vy:.4f} {vz:.4f} m/s {frame}, {yaw_rate:.4f} rad/s")  # noqa: T201  # its output
