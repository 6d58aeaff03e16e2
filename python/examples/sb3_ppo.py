"""PPO of Stable-Baselines3 on the environments of caudata."""

import argparse

import caudata
from caudata.sb3 import SB3VecEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot")
    parser.add_argument("--task", default="quick")
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--steps", type=int, default=6_000_000)
    parser.add_argument("--n-steps", type=int, default=48)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
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
    model.learn(options.steps)
    print("SB3: %d environment steps" % model.num_timesteps)


if __name__ == "__main__":
    main()
