"""PPO of Stable-Baselines3 on the environments of caudata, up to a policy file that every program takes."""

import argparse
from pathlib import Path

import caudata
import torch
from caudata.sb3 import SB3VecEnv, write_policy
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize


class Progress(BaseCallback):
    """Tells the environments how far training is: pushes and costs of a preset may grow with it."""

    def __init__(self, envs: caudata.VecEnv) -> None:
        super().__init__()
        self.envs = envs

    def _on_rollout_start(self) -> None:
        self.envs.set_progress(self.num_timesteps)

    def _on_step(self) -> bool:
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot")
    parser.add_argument("--task", help="without one, the preset made for the robot")
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--steps", type=int, default=6_000_000)
    parser.add_argument("--n-steps", type=int, default=48)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/sb3"), help="folder for policy and curve")
    options = parser.parse_args()
    # Networks this small are slower on several threads.
    torch.set_num_threads(1)
    envs = caudata.make_vec(options.robot, options.task, options.num_envs, seed=options.seed)
    learned = VecNormalize(VecMonitor(SB3VecEnv(envs)), gamma=0.97)
    model = PPO(
        "MlpPolicy",
        learned,
        n_steps=options.n_steps,
        batch_size=options.num_envs * options.n_steps // 4,
        n_epochs=2,
        gamma=0.97,
        learning_rate=1e-3,
        target_kl=0.03,
        max_grad_norm=1.0,
        policy_kwargs={"net_arch": [128, 64]},
        seed=options.seed,
        verbose=1,
        device="cpu",
    )
    model.set_logger(configure(str(options.out), ["stdout", "csv"]))
    model.learn(options.steps, callback=Progress(envs))
    policy = write_policy(options.out / "policy.onnx", model)
    print("SB3: %d environment steps, %s" % (model.num_timesteps, policy))


if __name__ == "__main__":
    main()
