"""Whole-body locomotion for servo robots: simulation, training, diagnosis.

Arrays are ``float32``, in SI units and radians. ``N`` environments (lanes), ``D`` observation values, ``A`` actions.
"""

from importlib.metadata import version

from ._data import policies, policy_path, presets, robot_path, robots
from ._diagnosis import Cause, Report, diagnose
from ._environment import Env, VecEnv, make, make_vec
from ._evaluation import Evaluation, evaluate
from ._log import Log, read_log
from ._policy import Policy, write_policy
from ._programs import ProgramError, run
from ._signals import Signals

__version__ = version("caudata")

__all__ = [
    "Cause",
    "Env",
    "Evaluation",
    "Log",
    "Policy",
    "ProgramError",
    "Report",
    "Signals",
    "VecEnv",
    "diagnose",
    "evaluate",
    "make",
    "make_vec",
    "policies",
    "policy_path",
    "presets",
    "read_log",
    "robot_path",
    "robots",
    "run",
    "write_policy",
]
