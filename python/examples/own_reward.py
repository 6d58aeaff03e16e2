"""A reward and an observation of one's own, written over the whole batch with NumPy."""

import caudata
import numpy as np


def reward(signals: caudata.Signals, actions: np.ndarray) -> np.ndarray:
    """Forward speed as commanded, at little power: [N]."""
    off_mps = signals.com_vel_mps[:, 0] - signals.command[:, 0]
    power_w = np.abs(signals.mech_power_w).sum(axis=1)
    return np.exp(-np.square(off_mps) / 0.07) - 0.01 * power_w


def observation(task: np.ndarray, signals: caudata.Signals) -> np.ndarray:
    """What the task observes, and the true height: [N, D + 1]."""
    return np.concatenate([task, signals.com_height_m[:, None]], axis=1)


def main() -> None:
    envs = caudata.make_vec("polymander", "flat", 32, seed=1, reward=reward, observation=observation)
    policy = caudata.Policy("flat")
    observations, _ = envs.reset(options={"command": (0.3, 0.0, 0.0)})
    total = np.zeros(envs.num_envs)
    for _ in range(250):
        observations, rewards, _, _, _ = envs.step(policy(observations[:, :-1]))
        total += rewards
    print("mean reward per step %.3f" % (total.mean() / 250))


if __name__ == "__main__":
    main()
