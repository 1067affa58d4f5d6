"""Small networks, batches and losses that the tests of loss and learner share."""

import warnings
from copy import deepcopy

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import ProbabilisticActor, TanhNormal

from tests.mpfa.transitions import seeded
from torchrl_mpfa import (
    ActorCriticLearner,
    DQNLearner,
    SignalDQNLoss,
    make_actor,
    make_critic,
    make_ddpg_loss,
    make_sac_loss,
    make_stochastic_actor,
    make_td3_loss,
    make_value_network,
)
from torchrl_mpfa.learners.compiled import CompiledUpdate
from torchrl_mpfa.networks import StochasticActor

GAMMA = 0.9
BOUNDS = (-1.0, 1.0)
KINDS = ["ddpg", "td3", "sac"]
CRITICS_LOSS = {"ddpg": "loss_value", "td3": "loss_qvalue", "sac": "loss_qvalue"}
"""TorchRL's name of the critics' loss."""
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


def make_loss(seed=0, **kwargs):
    return make_ddpg_loss(*make_networks(seed), gamma=GAMMA, **kwargs)


def without_shortcut(actor, critic):
    """The same networks as modules that must be called with tensordicts."""
    critic = TensorDictModule(critic.module, critic.in_keys, critic.out_keys)
    if not isinstance(actor, StochasticActor):
        return TensorDictModule(actor.module, actor.in_keys, actor.out_keys), critic
    inner = actor.module[0]
    inner = TensorDictModule(inner.module, inner.in_keys, inner.out_keys)
    keys, spec = {"loc": "preactivation", "scale": "scale"}, actor.spec["action"]
    return ProbabilisticActor(inner, keys, spec=spec, distribution_class=TanhNormal), critic


def make_of(kind, *, networks=None, **options):
    """A loss of any kind whose targets differ from its networks, lest a mix-up goes unseen."""
    if networks is None:
        networks = make_networks(stochastic=kind == "sac")
    make, more = {
        "ddpg": (make_ddpg_loss, {}),
        "td3": (make_td3_loss, {"bounds": BOUNDS}),
        "sac": (make_sac_loss, {"alpha_init": 0.3}),
    }[kind]
    loss = make(*networks, **{"gamma": GAMMA, **more, **options})
    with torch.no_grad():
        for name, value in loss.named_buffers():
            if name.startswith("target_"):
                value.mul_(0.7)
    return loss


def make_learner(kind="ddpg", seed=0, *, of_loss=None, **options):
    """A learner of any kind whose targets differ from its networks."""
    networks = make_networks(seed, stochastic=kind == "sac")
    loss = make_of(kind, **{"networks": networks, **(of_loss or {})})
    return ActorCriticLearner(loss, **{"actor_lr": 1e-3, "critic_lr": 1e-3, **options})


def make_discrete(size=5, **options):
    """A learner of four actions."""
    return DQNLearner(SignalDQNLoss(make_value_network(size, 4, width=8)), **options)


def critics_of(loss, params):
    """Each of the critics as a function of observation and action."""
    found = []
    for index in range(2):
        critic = deepcopy(loss.qvalue_network)
        params[index].detach().to_module(critic)
        found.append(critic.module)
    return found


def evaluate(loss, batch, seed=1):
    """All losses by the same random numbers, of smoothed targets or random actions."""
    torch.manual_seed(seed)
    return loss(batch)


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


def parameter_gradients(loss):
    """Gradients by parameter name, of those parameters that have one."""
    return {n: p.grad for n, p in loss.named_parameters() if p.grad is not None}


def differentiate_at_once(loss, batch, *, trains="both", loss_function=None):
    """Set gradients and write signals by the trace that a compiled update is made of."""
    for parameter in loss.parameters():
        parameter.grad = None
    state = deepcopy(loss.state_dict())
    # A program takes no steps of RAdam, but gives the gradients.
    learner = ActorCriticLearner(loss, optimizer="radam")
    loss.load_state_dict(state)  # A learner sets the targets to the networks.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="steps of the RAdam are not compiled")
        return CompiledUpdate(learner, {"disable": True})(batch, trains, loss_function)[0]
