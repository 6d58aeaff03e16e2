"""PPO of rsl_rl on the environments of caudata, up to a policy file that every program takes."""

import argparse
from pathlib import Path

import caudata
import torch
from caudata.rsl_rl import RslRlVecEnv, write_policy
from rsl_rl.runners import OnPolicyRunner


def network(gaussian: bool) -> dict:
    out = {"class_name": "MLPModel", "hidden_dims": [128, 64], "activation": "elu", "obs_normalization": True}
    if gaussian:
        out["distribution_cfg"] = {"class_name": "GaussianDistribution", "init_std": 1.0}
    return out


CONFIGURATION = {
    "num_steps_per_env": 48,
    "save_interval": 500,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": network(True),
    "critic": network(False),
    "algorithm": {
        "class_name": "PPO",
        "num_learning_epochs": 2,
        "num_mini_batches": 4,
        "learning_rate": 1e-3,
        "schedule": "adaptive",
        "desired_kl": 0.01,
        "gamma": 0.97,
        "lam": 0.95,
        "clip_param": 0.2,
        "entropy_coef": 0.0,
        "value_loss_coef": 0.5,
        "max_grad_norm": 1.0,
        "use_clipped_value_loss": True,
        "rnd_cfg": None,
        "symmetry_cfg": None,
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot")
    parser.add_argument("--task", help="without one, the preset made for the robot")
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/rsl_rl"), help="folder for policy and curves")
    options = parser.parse_args()
    # Networks this small are slower on several threads.
    torch.set_num_threads(1)
    torch.manual_seed(options.seed)
    envs = caudata.make_vec(options.robot, options.task, options.num_envs, seed=options.seed)
    learned = RslRlVecEnv(envs)
    runner = OnPolicyRunner(learned, CONFIGURATION, str(options.out), "cpu")
    runner.learn(options.iterations)
    policy = write_policy(options.out / "policy.onnx", runner)
    print("rsl_rl: %d environment steps, %s" % (learned.steps, policy))


if __name__ == "__main__":
    main()
