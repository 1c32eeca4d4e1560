"""The update once more, written from the equations of ``docs/algorithm.md`` by loops over windows and steps.

Slow, in float32, without batches, masks or padding: a reference for ``learner/update.py``.
"""

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from rmc.common.agent import Agent, Memory, Normalizer
from rmc.learner.config import UpdateConfig

REACHES_MEMORY = {1: "MV", 2: "V", 3: "M", 4: "MVP", 5: "MP", 6: "VP"}  # model, value, policy: table 1 of the paper
ALTERNATE = (("MG", "world_model"), ("F", "next_frame"), ("V", "critic"), ("P", "policy"), ("T", None))


class Known(NamedTuple):
    """The memory after an observation."""

    h: Tensor
    o: Tensor


class PlainUpdate:
    """Losses by name: M model, G grounding, F fill, V value, P policy, T temperature."""

    def __init__(self, agent: Agent, burn_in: int, config: UpdateConfig, seed: int) -> None:
        self.agent, self.burn_in, self.c = agent, burn_in, config
        self.target_critic, self.target_memory = copy.deepcopy(agent.critic), copy.deepcopy(agent.memory)
        self.generator = torch.Generator().manual_seed(seed)
        self.variance_sum = self.variance_weight = 0.0
        everything = ["world_model", "next_frame", "critic", "policy", None]
        self.stages = [names for names, part in ALTERNATE if part != "next_frame" or agent.config.impute_missing]
        groups = (
            [everything]
            if config.update_order == "joint"
            else [[part] for names, part in ALTERNATE if names in self.stages]
        )
        self.optimizers = [self._optimizer(parts) for parts in groups]

    def _optimizer(self, parts: Sequence[str | None]) -> torch.optim.Adam:
        rate = self.c.learning_rate
        own = [getattr(self.agent, part) for part in parts if part is not None]
        heads = [p for module in own if module is not None for p in module.parameters()]
        groups = [
            {"params": list(self.agent.memory.parameters()), "lr": self.c.memory_learning_scale * rate},
            {"params": heads, "lr": rate},
        ]
        if None in parts:
            groups.append({"params": [self.agent.log_alpha], "lr": self.c.alpha_learning_rate})
        return torch.optim.Adam([group for group in groups if group["params"]], fused=False)

    def __call__(self, rows: np.ndarray, importance: np.ndarray, beta: float) -> tuple[dict[str, float], list[float]]:
        """One update; the losses as they were before it, and the windows' priorities."""
        wholes = ["MGFVPT"] if self.c.update_order == "joint" else self.stages
        values: dict[str, float] = {}
        priorities: list[float] = []
        for names, optimizer in zip(wholes, self.optimizers, strict=True):
            losses, new_priorities, variance = self.losses(rows, importance, beta)
            self.agent.zero_grad()
            sum((losses[name] for name in names), torch.zeros(())).backward()
            if self.c.clip_norm:
                torch.nn.utils.clip_grad_norm_(self.agent.parameters(), self.c.clip_norm)
            optimizer.step()
            values |= {name: losses[name].item() for name in names}
            if "V" in names:
                priorities, moved = new_priorities, variance
        if self.c.curiosity_scale == "std":
            self.variance_sum, self.variance_weight = moved
        with torch.no_grad():
            for target, source in ((self.target_critic, self.agent.critic), (self.target_memory, self.agent.memory)):
                for old, new in zip(target.parameters(), source.parameters(), strict=True):
                    old.copy_(self.c.polyak * old + (1.0 - self.c.polyak) * new)
        return values, priorities

    def unroll(self, memory: Memory, row: np.void) -> dict[int, Known]:
        """By observation, from the first trained one on; the burn-in without gradient."""
        h, known, impute = torch.tensor(row["state"])[: memory.gru.hidden_size], {}, self.impute(row)
        for t in range(int(row["first"]), int(row["last"]) + 1):
            if t == self.burn_in:
                h = h.detach()
            previous = row["prev_action"] if t == row["first"] else row["action"][t - 1]
            e = self.embedded(memory, row, t, impute[t], torch.tensor(previous))
            h = torch.zeros_like(h) if self.agent.config.head_input == "observation" else gru(memory, e, h)
            known[t] = Known(h, impute[t])
        return {t: known[t] for t in range(self.burn_in, int(row["last"]) + 1)}

    def embedded(self, memory: Memory, row: np.void, t: int, o: Tensor, previous: Tensor) -> Tensor:
        flag = [torch.tensor(row["missing"][t]).float()] if self.agent.config.missing_flag else []
        return memory.embed(torch.cat([o, previous, *flag]))

    @torch.no_grad()
    def impute(self, row: np.void) -> dict[int, Tensor]:
        """By observation, what the memory is given: for what is missing what is expected, where it is asked."""
        memory, numbers = self.agent.memory, {}
        h, last = torch.tensor(row["state"]).tensor_split([self.agent.config.hidden])
        for t in range(int(row["first"]), int(row["last"]) + 1):
            previous = torch.tensor(row["prev_action"] if t == row["first"] else row["action"][t - 1])
            numbers[t] = self.seen(row, t)
            if self.agent.config.impute_missing:
                expected = self.agent.next_frame(h, last, previous).clamp(-10, 10) if last.any() else 0 * last
                numbers[t] = torch.where(torch.tensor(row["missing"][t] > 0), expected, numbers[t])
            last = numbers[t]
            without = self.agent.config.head_input == "observation"
            h = 0 * h if without else gru(memory, self.embedded(memory, row, t, numbers[t], previous), h)
        return numbers

    def seen(self, row: np.void, t: int) -> Tensor:
        """The observation as the networks see it."""
        o = normalized(self.agent.normalizer, row["observation"][t])
        return torch.where(torch.tensor(row["missing"][t] > 0), 0.0, o)

    def critics_z(self, row: np.void, t: int, z: Tensor) -> Tensor:
        """What the critics read."""
        normalizer = self.agent.privileged_normalizer
        return z if normalizer is None else torch.cat([z, normalized(normalizer, row["privileged"][t])])

    @staticmethod
    def by_flag(error: Tensor, seen: np.ndarray) -> list[Tensor]:
        """The mean error of what each flag says is seen: of the whole frame, or one number."""
        parts = error.chunk(len(seen))
        return [part.mean() for part, is_seen in zip(parts, seen, strict=True) if is_seen]

    def z(self, known: Known) -> Tensor:
        parts = {"hidden": known.h, "observation": known.o}
        return torch.cat([parts[name] for name in self.agent.config.head_input.split("+")])

    def sample(self, z: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.agent.policy(z)
        u = mean + log_std.exp() * noise
        log_pi = torch.distributions.Normal(mean, log_std.exp()).log_prob(u).sum()
        return torch.tanh(u), log_pi - torch.log(1.0 - torch.tanh(u) ** 2).sum()

    def losses(
        self, rows: np.ndarray, importance: np.ndarray, beta: float
    ) -> tuple[dict[str, Tensor], list[float], tuple[float, float]]:
        """Every loss, the priorities, and what the running variance of curiosity would become."""
        c, agent = self.c, self.agent
        alpha = agent.log_alpha.exp().detach()
        noise = torch.randn(
            (len(rows), rows["action"].shape[1] - self.burn_in + 1, agent.action_dim), generator=self.generator
        )
        sums: dict[str, list[Tensor]] = {name: [] for name in ("M", "observation", "reward", "F", "V", "P", "T")}
        errors = []  # of every window, by step
        known = [(self.unroll(agent.memory, row), self.unroll(self.target_memory, row)) for row in rows]
        joint = self.joint_values(rows, known, noise) if agent.config.critic_batch_norm else {}
        for b, (row, (online, target)) in enumerate(zip(rows, known, strict=True)):
            latent = target if c.latent_target == "ema" else online
            window = {}
            for t in range(self.burn_in, int(row["last"])):
                z = self.z(online[t])
                a = torch.tensor(row["action"][t])
                predicted = agent.world_model(self.reaching("M", z), a)
                difference = predicted.hidden_change - (latent[t + 1].h - latent[t].h).detach()
                error = difference.abs().mean() if c.model_norm == "l1" else difference.square().mean().sqrt()
                if not self.ends(row, t):
                    sums["M"].append(error)
                window[t] = 0.0 if self.ends(row, t) else error.item()
                if agent.config.grounding:
                    wanted = self.seen(row, t + 1) - online[t].o
                    seen = (row["missing"][t + 1] == 0) & (agent.config.impute_missing | (row["missing"][t] == 0))
                    sums["observation"] += self.by_flag((predicted.observation_change - wanted).abs(), seen)
                    sums["reward"].append((predicted.reward - float(row["reward"][t])).abs())
                if agent.config.impute_missing:
                    expected = agent.next_frame(online[t].h.detach(), online[t].o, a)
                    seen = row["missing"][t + 1] == 0
                    sums["F"] += self.by_flag((expected - self.seen(row, t + 1)).abs(), seen)
                pi, log_pi = self.sample(self.reaching("P", z), noise[b, t - self.burn_in])
                judged = self.reaching("P", z) if c.policy_through_q else z.detach()
                q_pi = twin_q(agent.critic, self.critics_z(row, t, judged), pi, frozen=True)
                sums["P"].append(alpha * log_pi - (q_pi[0] if c.policy_q == "first" else q_pi.min()))
                sums["T"].append(-agent.log_alpha * (log_pi.detach() + self.c.target_entropy * agent.action_dim))
            errors.append(window)
        i, variance = self.scaled(errors)
        priorities = []
        for b, (row, (online, target)) in enumerate(zip(rows, known, strict=True)):
            td_errors = []
            for t in range(self.burn_in, int(row["last"])):
                next_q = {step: values[1] for (window, step), values in joint.items() if window == b}
                y = self.target(row, t, i[b], beta, online, target, noise[b], next_q)
                read = self.critics_z(row, t, self.reaching("V", self.z(online[t])))
                q = joint[b, t][0] if joint else twin_q(agent.critic, read, torch.tensor(row["action"][t]))
                sums["V"].append(float(importance[b]) * 0.5 * ((q[0] - y) ** 2 + (q[1] - y) ** 2))
                td_errors.append((q.detach() - y).abs().mean().item())
            priorities.append(c.eta * max(td_errors) + (1.0 - c.eta) * sum(td_errors) / len(td_errors))
        mean = {name: torch.stack(values).mean() if values else torch.zeros(()) for name, values in sums.items()}
        mean["G"] = mean.pop("observation") + mean.pop("reward")
        return mean, priorities, variance

    def joint_values(
        self, rows: np.ndarray, known: list[Any], noise: Tensor
    ) -> dict[tuple[int, int], tuple[Tensor, Tensor]]:
        """By window and step, Q of it and of the next, all normalised together."""
        steps, now, after = [], [], []
        for b, (row, (online, target)) in enumerate(zip(rows, known, strict=True)):
            for t in range(self.burn_in, int(row["last"])):
                read = self.critics_z(row, t, self.reaching("V", self.z(online[t])))
                now.append(torch.cat([read, torch.tensor(row["action"][t])]))
                then = self.z((target if self.c.target_memory == "ema" else online)[t + 1])
                pi, _ = self.sample(self.z(online[t + 1]), noise[b, t + 1 - self.burn_in])
                after.append(torch.cat([self.critics_z(row, t + 1, then), pi]).detach())
                steps.append((b, t))
        q, next_q = jointly_normed_q(self.agent.critic, torch.stack(now + after)).chunk(2)
        return dict(zip(steps, zip(q, next_q.detach(), strict=True), strict=True))

    def reaching(self, loss: str, z: Tensor) -> Tensor:
        return z if loss in REACHES_MEMORY[self.c.scheme] else z.detach()

    @staticmethod
    def ends(row: np.void, t: int) -> bool:
        return bool(row["terminated"]) and t == row["last"] - 1

    def scaled(self, errors: list[dict[int, float]]) -> tuple[list[dict[int, float]], tuple[float, float]]:
        if self.c.curiosity_scale == "raw":
            return errors, (0.0, 0.0)
        variance = float(np.var([error for window in errors for error in window.values()]))
        total, weight = 0.99 * self.variance_sum + 0.01 * variance, 0.99 * self.variance_weight + 0.01
        deviation = (total / weight) ** 0.5
        return [{t: error / deviation for t, error in window.items()} for window in errors], (total, weight)

    @torch.no_grad()
    def target(
        self, row: np.void, t: int, i: dict[int, float], beta: float,
        online: dict[int, Known], target: dict[int, Known], noise: Tensor, next_q: dict[int, Tensor],
    ) -> float:  # fmt: skip
        """r + ... for up to n steps, then the soft value of where they lead; ``next_q`` has it where one pass does."""
        c, y, discount = self.c, 0.0, 1.0
        for _ in range(c.n_step):
            y += discount * (float(row["reward"][t]) + beta * i[t])
            discount *= c.gamma
            if self.ends(row, t):
                return y
            t += 1
            if t == row["last"]:
                break
        pi, log_pi = self.sample(self.z(online[t]), noise[t - self.burn_in])
        reads = target if c.target_memory == "ema" else online
        q = next_q[t - 1] if next_q else twin_q(self.target_critic, self.critics_z(row, t, self.z(reads[t])), pi)
        return y + discount * float(q.min() - self.agent.log_alpha.exp() * log_pi)


def normalized(normalizer: Normalizer, numbers: np.ndarray) -> Tensor:
    x = torch.tensor(numbers)
    return ((x - normalizer.mean) / normalizer.std).clamp(-10, 10) if normalizer.enabled else x


def gru(memory: Memory, e: Tensor, h: Tensor) -> Tensor:
    """h' = (1 - z) n + z h."""
    net = memory.gru
    x_r, x_z, x_n = (net.weight_ih_l0 @ e + net.bias_ih_l0).chunk(3)
    h_r, h_z, h_n = (net.weight_hh_l0 @ h + net.bias_hh_l0).chunk(3)
    r, z = torch.sigmoid(x_r + h_r), torch.sigmoid(x_z + h_z)
    return (1.0 - z) * torch.tanh(x_n + r * h_n) + z * h


def twin_q(critic: torch.nn.Module, z: Tensor, a: Tensor, frozen: bool = False) -> Tensor:
    """(2,): each critic by itself."""
    values = []
    for j in (0, 1):
        x = torch.cat([z, a])
        for depth, layer in enumerate(critic.layers):
            weight, bias = layer.weight[j], layer.bias[j, 0]
            weight, bias = (weight.detach(), bias.detach()) if frozen else (weight, bias)
            x = running_normed(critic, depth, j if depth else 0, x, frozen) @ weight + bias
            x = F.relu(x) if depth < 2 else x
        values.append(x[0])
    return torch.stack(values)


def running_normed(critic: torch.nn.Module, depth: int, net: int, x: Tensor, frozen: bool) -> Tensor:
    if not critic.norms:
        return x
    norm = critic.norms[depth]
    x = (x - norm.mean[net, 0]) / (norm.variance[net, 0] + 1e-3).sqrt()
    gain, offset = gain_and_offset(norm, net)
    return x * gain.detach() + offset.detach() if frozen else x * gain + offset


def jointly_normed_q(critic: torch.nn.Module, inputs: Tensor) -> Tensor:
    """(N, in) -> (N, 2), normalised by all rows, whose statistics move the running ones."""
    read = normed_by_rows(critic.norms[0], 0, inputs)
    values = []
    for j in (0, 1):
        x = read
        for norm, layer in zip(critic.norms[1:], critic.layers[:-1], strict=True):
            x = normed_by_rows(norm, j, F.relu(x @ layer.weight[j] + layer.bias[j, 0]))
        values.append(x @ critic.layers[-1].weight[j, :, 0] + critic.layers[-1].bias[j, 0])
    return torch.stack(values, 1)


def normed_by_rows(norm: torch.nn.Module, net: int, x: Tensor) -> Tensor:
    mean, variance = x.mean(0), x.var(0, correction=0)
    for running, new in ((norm.mean, mean), (norm.variance, variance)):
        running[net, 0] = 0.99 * running[net, 0] + 0.01 * new.detach()
    gain, offset = gain_and_offset(norm, net)
    return (x - mean) / (variance + 1e-3).sqrt() * gain + offset


def gain_and_offset(norm: torch.nn.Module, net: int) -> tuple[Tensor, Tensor]:
    if norm.gain is None:
        return torch.ones(()), torch.zeros(())
    return norm.gain[net, 0], norm.offset[net, 0]
