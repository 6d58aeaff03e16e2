"""PPO in one file, in the manner of CleanRL, on the environments of caudata. Needs torch."""

import argparse
import time

import caudata
import numpy as np
import torch
from torch import nn


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    layers = [nn.Linear(inputs, 128), nn.ELU(), nn.Linear(128, 64), nn.ELU(), nn.Linear(64, outputs)]
    for layer in layers[::2]:
        nn.init.orthogonal_(layer.weight, gain if layer is layers[-1] else 2**0.5)
        nn.init.zeros_(layer.bias)
    return nn.Sequential(*layers)


class Agent(nn.Module):
    def __init__(self, observations: int, actions: int) -> None:
        super().__init__()
        self.actor, self.critic = network(observations, actions, 0.01), network(observations, 1, 1.0)
        self.log_std = nn.Parameter(torch.zeros(actions))
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(observations, dtype=torch.float64))
        self.register_buffer("spread", torch.ones(observations, dtype=torch.float64))

    def see(self, observations: torch.Tensor) -> None:
        """Takes observations into the normaliser's mean and variance."""
        batch = observations.double()
        n = batch.shape[0]
        delta, total = batch.mean(0) - self.mean, self.count + n
        moment = self.spread * self.count + batch.var(0, unbiased=False) * n + delta**2 * self.count * n / total
        self.mean += delta * n / total
        self.spread, self.count = moment / total, total

    def scaled(self, observations: torch.Tensor) -> torch.Tensor:
        return ((observations - self.mean) / (self.spread + 1e-8).sqrt()).float().clamp(-10, 10)

    def distribution(self, scaled: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(self.actor(scaled), self.log_std.exp())


def train(options: argparse.Namespace) -> float:
    """Trains; returns the mean return of the episodes that ended last."""
    torch.manual_seed(options.seed)
    torch.set_num_threads(options.threads)
    lanes, steps = options.num_envs, options.num_steps
    envs = caudata.make_vec(options.robot, options.task, lanes, seed=options.seed, threads=options.threads)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimiser = torch.optim.Adam(agent.parameters(), lr=1e-3, eps=1e-5)
    batch = lanes * steps
    shape = (steps, lanes)
    obs = torch.zeros(shape + envs.single_observation_space.shape)
    actions = torch.zeros(shape + envs.single_action_space.shape)
    log_probs, rewards, values, dones = (torch.zeros(shape) for _ in range(4))
    returns: list = []
    lr = 1e-3
    now = torch.from_dlpack(envs.reset(seed=options.seed)[0])
    started = time.perf_counter()
    for iteration in range(1, options.iterations + 1):
        with torch.no_grad():
            for step in range(steps):
                agent.see(now)
                obs[step] = scaled = agent.scaled(now)
                distribution = agent.distribution(scaled)
                actions[step] = action = distribution.sample()
                log_probs[step] = distribution.log_prob(action).sum(1)
                values[step] = agent.critic(scaled)[:, 0]
                out, reward, terminated, truncated, infos = envs.step(action.numpy())
                now, rewards[step] = torch.from_dlpack(out), torch.from_dlpack(reward)
                dones[step] = torch.from_numpy((terminated | truncated).astype(np.float32))
                if infos:
                    ended = infos["_final_info"]
                    returns = (returns + list(infos["final_info"]["episode"]["r"][ended]))[-256:]
                    # An episode that the time limit ended would have gone on: its value counts.
                    last = np.stack(list(infos["final_obs"][ended]))
                    worth = agent.critic(agent.scaled(torch.from_numpy(last)))[:, 0]
                    rewards[step, ended] += options.gamma * worth * torch.from_numpy(truncated[ended].astype(np.float32))
            envs.set_progress(iteration * batch)
            advantage, following = torch.zeros(lanes), agent.critic(agent.scaled(now))[:, 0]
            advantages = torch.zeros(shape)
            for step in reversed(range(steps)):
                alive = 1.0 - dones[step]
                delta = rewards[step] + options.gamma * alive * following - values[step]
                advantages[step] = advantage = delta + options.gamma * 0.95 * alive * advantage
                following = values[step]
            targets = advantages + values
        flat = [x.reshape((batch,) + x.shape[2:]) for x in (obs, actions, log_probs, advantages, targets)]
        for _ in range(2):
            for rows in torch.randperm(batch).chunk(4):
                o, a, old, gain, target = (x[rows] for x in flat)
                distribution = agent.distribution(o)
                ratio = (distribution.log_prob(a).sum(1) - old).exp()
                gain = (gain - gain.mean()) / (gain.std() + 1e-8)
                surrogate = torch.min(ratio * gain, ratio.clamp(0.8, 1.2) * gain).mean()
                loss = 0.5 * (agent.critic(o)[:, 0] - target).square().mean() - surrogate
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
                optimiser.step()
        with torch.no_grad():
            fresh = agent.distribution(flat[0]).log_prob(flat[1]).sum(1)
            kl = (flat[2] - fresh + (fresh - flat[2]).exp() - 1).mean().item()
        # As rsl_rl does: a step size at which the policy changes by about this much per iteration.
        lr = max(1e-5, lr / 1.5) if kl > 0.02 else min(3e-3, lr * 1.5) if kl < 0.005 else lr
        for group in optimiser.param_groups:
            group["lr"] = lr
        if iteration % options.print_every == 0:
            rate = iteration * batch / (time.perf_counter() - started)
            mean = float(np.mean(returns)) if returns else float("nan")
            print("%5d/%d  %6.0f steps/s  return %.2f" % (iteration, options.iterations, rate, mean), flush=True)
    if options.save:
        torch.save(agent.state_dict(), options.save)
    return float(np.mean(returns)) if returns else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robot")
    parser.add_argument("--task", help="without one, the preset made for the robot")
    parser.add_argument("--num-envs", type=int, default=128)
    parser.add_argument("--num-steps", type=int, default=48)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--gamma", type=float, default=0.97)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--print-every", type=int, default=20)
    parser.add_argument("--save")
    train(parser.parse_args())


if __name__ == "__main__":
    main()
