"""Small networks, batches and learners that the tests of learning share."""

from copy import deepcopy

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import DDPGLoss, SACLoss, TD3Loss, ValueEstimators

from benchmarks.paper.methods.averaged_ddpg import AveragedLearner
from benchmarks.paper.methods.ddpg_radam import RAdamLearner
from tests.mpfa.transitions import seeded
from torchrl_mpfa import (
    DQN,
    ActorCritic,
    make_actor,
    make_critic,
    make_stochastic_actor,
    make_value_network,
)
from torchrl_mpfa.networks import StochasticActor

GAMMA = 0.9
BOUNDS = (-1.0, 1.0)
KINDS = ["ddpg", "td3", "sac"]
OF_KIND = {"ddpg": {}, "td3": {"policy_noise": 0.2, "bounds": BOUNDS}, "sac": {"alpha": 0.3}}
UNTRACED = {"compile": {"disable": True}}
"""The function that torch.compile would make one program of, which takes seconds."""
TRACED = {"compile": {"backend": "eager"}}
"""Python stands in for the C++ compiler: what is traced is the same."""


def make_networks(seed=0, *, stochastic=False, size=5, **kwargs):
    """An actor and a critic that start far from zero, so that gradients are not tiny."""
    torch.manual_seed(seed)
    arguments = {"width": 16, "final_init": 0.5, **kwargs}
    make = make_stochastic_actor if stochastic else make_actor
    return make(size, 2, **arguments), make_critic(size, 2, **arguments)


def without_shortcut(actor, critic):
    """The same networks as modules that must be called with tensordicts."""
    critic = TensorDictModule(critic.module, critic.in_keys, critic.out_keys)
    if not isinstance(actor, StochasticActor):
        return TensorDictModule(actor.module, actor.in_keys, actor.out_keys), critic
    inner = actor.module[0]
    inner = TensorDictModule(inner.module, inner.in_keys, inner.out_keys)
    keys, spec = {"loc": "preactivation", "scale": "scale"}, actor.spec["action"]
    return ProbabilisticActor(inner, keys, spec=spec, distribution_class=TanhNormal), critic


class Both(AveragedLearner, RAdamLearner):
    """A learner with averaged targets and RAdam."""


def kind_of(options):
    """The class of learners that have these options."""
    averaged, other = "target_average" in options, "optimizer" in options
    kinds = {(True, True): Both, (True, False): AveragedLearner, (False, True): RAdamLearner}
    return kinds.get((averaged, other), ActorCritic)


def make_learner(kind="ddpg", seed=0, *, networks=None, **options):
    """A learner of any kind."""
    if networks is None:
        networks = make_networks(seed, stochastic=kind == "sac")
    given = {"gamma": GAMMA, "actor_lr": 1e-3, "critic_lr": 1e-3, **OF_KIND[kind], **options}
    return kind_of(options)(*networks, **given)


def make_apart(kind="ddpg", **options):
    """A learner whose targets differ from its networks, lest a mix-up goes unseen."""
    learner = make_learner(kind, **options)
    with torch.no_grad():
        for value in learner.targets.parameters():
            value.mul_(0.7)
    return learner


def make_torchrls(kind, learner, estimator=ValueEstimators.TD0, **options):
    """TorchRL's loss with the networks and targets of a learner."""
    kinds = {
        "ddpg": (DDPGLoss, {"delay_actor": True}),
        "td3": (TD3Loss, {"bounds": BOUNDS}),
        "sac": (SACLoss, {"alpha_init": 0.3}),
    }
    make, more = kinds[kind]
    critics = [getattr(critic, "network", critic) for critic in learner.networks["critics"]]
    given = {"loss_function": "l2", **more, **options}
    loss = make(deepcopy(learner.policy), deepcopy(critics[0]), **given)
    loss.make_value_estimator(estimator, gamma=learner.gamma)
    name = "value_network" if kind == "ddpg" else "qvalue_network"
    for prefix, parts in (("", learner.networks), ("target_", learner.targets)):
        networks = {name: [getattr(each, "network", each) for each in parts["critics"]]}
        if "actor" in parts:
            networks["actor_network"] = [getattr(parts["actor"], "network", parts["actor"])]
        for key, modules in networks.items():
            weights = [TensorDict.from_module(module).data for module in modules]
            stacked = torch.stack(weights) if key == "qvalue_network" else weights[0]
            getattr(loss, f"{prefix}{key}_params").data.update_(stacked)
    return loss


def gradients_of_torchrls(kind, loss):
    """Gradients of TorchRL's loss, by the names that a learner has for them."""
    name = "value_network" if kind == "ddpg" else "qvalue_network"
    found = {}
    for key, params in (
        ("actor", loss.actor_network_params),
        ("critics", getattr(loss, name + "_params")),
    ):
        for place, value in params.flatten_keys(".").items():
            if getattr(value, "grad", None) is None:
                continue
            if key == "actor":
                found[f"actor.{place}"] = value.grad
            else:
                of_each = value.grad if kind != "ddpg" else [value.grad]
                found |= {f"critics.{n}.{place}": grad for n, grad in enumerate(of_each)}
    return found


def make_discrete(size=5, **options):
    """A learner of four actions."""
    return DQN(make_value_network(size, 4, width=8), **options)


def differentiate(learner, batch, *, seed=1, trains="both", loss_function=None):
    """Set gradients and write signals without a step, by these random numbers; return the log."""
    torch.manual_seed(seed)
    learner.optimizer.zero_grad()
    return learner._differentiate(batch, trains, loss_function)


def gradients_of(learner):
    """Gradients by name, of those parameters that have one."""
    found = learner.networks.named_parameters()
    return {name.replace(".network.", "."): p.grad for name, p in found if p.grad is not None}


def make_batch(count=6, *, seed=0, weighted=False):
    """Transitions of which the second ended and the third was cut by a time limit."""
    generator = seeded(seed)
    terminated = torch.zeros(count, 1, dtype=torch.bool)
    truncated = torch.zeros(count, 1, dtype=torch.bool)
    terminated[1], truncated[2] = True, True
    batch = TensorDict(
        {
            "observation": torch.randn(count, 5, generator=generator),
            "action": torch.rand(count, 2, generator=generator) * 2 - 1,
            "next": {
                "observation": torch.randn(count, 5, generator=generator),
                "reward": torch.randn(count, 1, generator=generator),
                "terminated": terminated,
                "truncated": truncated,
                "done": terminated | truncated,
            },
        },
        [count],
    )
    if weighted:
        batch["priority_weight"] = torch.rand(count, generator=generator) + 0.1
    return batch
