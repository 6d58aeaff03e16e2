"""The true state of all lanes, for rewards and observations that are written in Python."""

from __future__ import annotations

from typing import Dict, Iterator

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


class Signals:
    """True state of all lanes after a control step, before any lane began its next episode.

    The arrays are the same objects after every step and are filled in place: copy what you want to keep. World frame
    where nothing else is said. ``N`` lanes, ``A`` actuated joints in policy order, ``F`` feet in the robot file's order.
    Means are over the control period.
    """

    command: Array
    """``[N, 3]`` the command in force in the step: forward and leftward velocity (m/s), yaw rate (rad/s)."""
    phase_rad: Array
    """``[N, F]`` phase of the gait clock for each foot, of the clock itself for robots without feet."""
    joint_pos_rad: Array
    """``[N, A]``."""
    joint_vel_radps: Array
    """``[N, A]``."""
    motor_torque_nm: Array
    """``[N, A]`` mean."""
    mech_power_w: Array
    """``[N, A]`` mean, signed."""
    heading_rad: Array
    """``[N]`` heading of the whole body."""
    com_vel_mps: Array
    """``[N, 3]`` velocity of the centre of mass in the heading frame: forward, left, up."""
    yaw_rate_radps: Array
    """``[N]`` of the whole body."""
    com_height_m: Array
    """``[N]`` centre of mass above the ground under the feet."""
    gyro_radps: Array
    """``[N, 3]`` IMU frame."""
    gravity: Array
    """``[N, 3]`` unit vector, IMU frame; level is (0, 0, -1)."""
    foot_height_m: Array
    """``[N, F]`` lowest point of each foot above the ground."""
    foot_vel_mps: Array
    """``[N, F, 3]``."""
    foot_force_n: Array
    """``[N, F, 3]`` contact force on each foot, mean."""
    trunk_force_n: Array
    """``[N]`` contact force on trunk and legs but not the feet, mean."""
    submerged: Array
    """``[N]`` 1 while the centre of mass is below the water's surface."""
    base_pos_m: Array
    """``[N, 3]`` origin of the base link."""
    base_quat_wxyz: Array
    """``[N, 4]`` world_from_base."""
    base_vel_mps: Array
    """``[N, 3]``."""
    base_angvel_radps: Array
    """``[N, 3]`` body frame."""
    com_pos_m: Array
    """``[N, 3]`` centre of mass of the whole robot."""
    foot_pos_m: Array
    """``[N, F, 3]`` centres of the feet."""
    tail_force_n: Array
    """``[N]`` contact force on links that carry no feet, mean."""

    def __init__(self, arrays: Dict[str, Array]) -> None:
        self.__dict__.update(arrays)

    def __getitem__(self, name: str) -> Array:
        return self.__dict__[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.__dict__)
