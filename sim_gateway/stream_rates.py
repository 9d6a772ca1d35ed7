"""Which messages PX4 sends by itself on which link, how often, and from which moment of its start-up on.

Rates are those of link_census.json (PX4 v1.17 SITL defaults). A message begins at the vehicle time at which PX4's first one was
recorded after start-up (lifecycle.json).
"""

from __future__ import annotations

GPS_FROM_S, LOCAL_FROM_S, HEARTBEAT_FROM_S, HOME_FROM_S, GLOBAL_FROM_S, POSITION_FLAG_FROM_S = 0.75, 0.78, 1.75, 2.76, 3.2, 3.77

# message: (Hz on the onboard link, Hz on the ground station link); 0: only when asked for
STREAM_RATES_HZ: dict[str, tuple[float, float]] = {
    "ALTITUDE": (10, 1),
    "ATTITUDE": (100, 50),
    "ATTITUDE_QUATERNION": (50, 50),
    "ATTITUDE_TARGET": (10, 50),
    "BATTERY_STATUS": (0.5, 0.5),
    "CURRENT_MODE": (0.5, 0.5),
    "DISTANCE_SENSOR": (10, 0.5),
    "ESTIMATOR_STATUS": (1, 0.5),
    "EXTENDED_SYS_STATE": (5, 1),
    "GLOBAL_POSITION_INT": (50, 50),
    "GPS_GLOBAL_ORIGIN": (0, 0),
    "GPS_RAW_INT": (8, 5),
    "HEARTBEAT": (1, 1),
    "HIGHRES_IMU": (50, 0),
    "HOME_POSITION": (0.5, 0.5),
    "LOCAL_POSITION_NED": (30, 50),
    "MISSION_CURRENT": (1, 1),
    "OBSTACLE_DISTANCE": (0, 0),
    "ODOMETRY": (30, 0),
    "PING": (1, 0.1),
    "POSITION_TARGET_LOCAL_NED": (10, 50),
    "SCALED_PRESSURE": (1, 1),
    "SERVO_OUTPUT_RAW": (10, 50),
    "SYSTEM_TIME": (1, 0),
    "SYS_STATUS": (5, 1),
    "TIMESYNC": (10, 0),
    "VFR_HUD": (10, 4),
    "VIBRATION": (0.5, 0.1),
    "CURRENT_EVENT_SEQUENCE": (1 / 3, 1 / 3),
    "GNSS_INTEGRITY": (1, 1),
    "LINK_NODE_STATUS": (1, 1),
    "OPEN_DRONE_ID_LOCATION": (1, 1),
    "OPEN_DRONE_ID_SYSTEM": (1, 1),
    "POSITION_TARGET_GLOBAL_INT": (10, 1),
    "TIME_ESTIMATE_TO_TARGET": (0.5, 0.5),
}
ONBOARD, GROUND = 0, 1  # column of STREAM_RATES_HZ
# vehicle time of the first one; of all others LOCAL_FROM_S
FROM_S = {
    "GPS_RAW_INT": GPS_FROM_S,
    "LOCAL_POSITION_NED": LOCAL_FROM_S,
    "ODOMETRY": LOCAL_FROM_S,
    "HEARTBEAT": HEARTBEAT_FROM_S,
    "HOME_POSITION": HOME_FROM_S,
    "GLOBAL_POSITION_INT": GLOBAL_FROM_S,
}
