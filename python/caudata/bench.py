"""``python -m caudata.bench``: environment steps per second on one thread, beside the same in Rust and beside others.

All take three turns in one run, in rounds; the figure is that of the median round of the best turn, in processor time
with all threads of the process (in Rust: in time), so that other work on the machine spoils little. A step of ours is
one of 20 ms with contacts, servos, delays, noise and reward; so is one of MuJoCo Playground's Go1, whose drives are
gains; a step of Ant is 50 ms of physics without a model of its drives.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import time
from functools import partial
from typing import Any, Callable, Dict, List, Tuple

import numpy as np

from . import _programs
from ._environment import make_vec

_TURNS = 3

Peer = Tuple[int, Callable[[], Any]]
"""Environments that one call steps, and the call."""


def ours(robot: str, task: str, lanes: int) -> Peer:
    envs = make_vec(robot, task, lanes, copy=False)
    envs.reset()
    # The gait-like motion of `caudata bench sim`, so that contacts come and go; 2π is 39.27 steps of 0.16.
    joints = np.arange(envs.action_space.shape[1])
    motion = [np.tile(np.float32(0.5 * np.sin(0.16 * k + joints)), (lanes, 1)) for k in range(39)]
    step = itertools.cycle(motion)
    return lanes, lambda: envs.step(next(step))


def gymnasium_ant(lanes: int) -> Peer:
    import gymnasium

    env = gymnasium.make("Ant-v5")
    env.reset(seed=1)
    actions = np.random.default_rng(1).uniform(-1, 1, (64,) + env.action_space.shape)
    at = 0

    def step() -> None:
        nonlocal at
        at = (at + 1) % len(actions)
        _, _, terminated, truncated, _ = env.step(actions[at])
        if terminated or truncated:
            env.reset()

    return 1, step


def of_envpool(task: str, lanes: int) -> Peer:
    import envpool

    envs = envpool.make(task, env_type="gymnasium", num_envs=lanes, num_threads=1)
    envs.reset()
    actions = np.random.default_rng(1).uniform(-1, 1, (lanes,) + envs.action_space.shape)
    return lanes, lambda: envs.step(actions)


def rust(lanes: int, seconds: float) -> float:
    """Environment steps per second of the same task without Python, from the median round."""
    words = ["bench", "sim", "--engine", "batch", "--scene", "flat", "--preset", "quick", "--json"]
    out = _programs.run(*words, "--seconds", str(seconds), "--lanes", str(lanes), quiet=True)
    return lanes / float(json.loads(out.splitlines()[-1])["round_median_s"])


def measure(lanes: int, seconds: float) -> Dict[str, float]:
    """Environment steps per second by name; a package that is not installed is left out."""
    makers: Dict[str, Callable[[int], Peer]] = {
        "caudata": partial(ours, "polymander", "quick"),
        "caudata quadruped": partial(ours, "quadruped", "quadruped"),
        "gymnasium Ant-v5": gymnasium_ant,
        "EnvPool Ant-v4": partial(of_envpool, "Ant-v4"),
        # MuJoCo Playground's quadruped on MuJoCo in C++
        "EnvPool Go1Joystick": partial(of_envpool, "Go1JoystickFlatTerrain-v1"),
    }
    peers: Dict[str, Peer] = {}
    for name, maker in makers.items():
        try:
            peers[name] = maker(lanes)
        except Exception as missing:  # whatever keeps a package of somebody else from working here
            print("left out: %s (%s)" % (name, str(missing).splitlines()[0]))
    rates: Dict[str, float] = {}
    for _ in range(_TURNS):
        rounds: Dict[str, List[float]] = {name: [] for name in peers}
        end = time.perf_counter() + seconds * len(peers) / _TURNS
        while time.perf_counter() < end:
            for name, (_, step) in peers.items():
                # a slice long enough that the change of caches does not matter
                stop = time.perf_counter() + 0.05
                while time.perf_counter() < stop:
                    begun = time.process_time()
                    step()
                    rounds[name].append(time.process_time() - begun)
        turn = {name: peers[name][0] / statistics.median(times) for name, times in rounds.items()}
        turn["caudata in Rust"] = rust(lanes, seconds / _TURNS)
        rates = {name: max(rate, rates.get(name, 0.0)) for name, rate in turn.items()}
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m caudata.bench", description=__doc__)
    parser.add_argument("--lanes", type=int, default=128, help="environments that are stepped together")
    parser.add_argument("--seconds", type=float, default=5.0, help="how long each is measured")
    parser.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    options = parser.parse_args()
    rates = measure(options.lanes, options.seconds)
    if options.json:
        print(json.dumps(rates))
        return
    print("%-20s %14s %18s" % ("one thread", "env steps/s", "caudata / this"))
    for name, rate in rates.items():
        print("%-20s %14.0f %18.2f" % (name, rate, rates["caudata"] / rate))


if __name__ == "__main__":
    main()
