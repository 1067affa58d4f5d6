"""Every method out of Hydra's groups, with every setting of the catalogue as a field."""

from dataclasses import fields

import pytest
from hydra import compose, initialize
from hydra.utils import instantiate
from omegaconf import OmegaConf

from torchrl_mpfa import SignalReplayBuffer, make_actor
from torchrl_mpfa.integrations.hydra import CONFIGS, register_configs
from torchrl_mpfa.methods import METHODS, Replay

SMALL = ["capacity=32", "batch_size=4"]
OF_SOME = {"per": ["alpha=0.3"], "mpfa_per": ["alpha=0.3", "positive_above=mean"]}
CHOOSY = {"la3p", "klper", "ref_er", "uniform_halves"}
OF_ONE_BATCH = sorted(set(METHODS) - CHOOSY)


@pytest.fixture(scope="module")
def registered():
    register_configs()


@pytest.fixture
def composed(registered):
    with initialize(version_base=None, config_path=None):
        yield lambda *overrides: compose(overrides=list(overrides))


@pytest.fixture(scope="module")
def at_once(registered):
    """All methods, each in a package of its own; one at a time, Hydra takes seconds."""
    with initialize(version_base=None, config_path=None):
        return compose(
            overrides=[
                *(f"+replay@{name}={name}" for name in METHODS),
                *(f"+replay_buffer@one.{name}=signal_{name}" for name in OF_ONE_BATCH),
                *(f"{name}.{each}" for name in METHODS for each in SMALL),
                *(
                    f"one.{name}.{each}"
                    for name in OF_ONE_BATCH
                    for each in (*SMALL, *OF_SOME.get(name, []))
                ),
            ]
        )


@pytest.mark.parametrize("name", METHODS)
def test_every_method_is_made_by_its_name(at_once, name):
    config = at_once[name]
    more = (
        {"policy": make_actor(6, 2, width=8), "sigma": 0.2} if name in {"klper", "ref_er"} else {}
    )
    replay = instantiate(config, **more)
    assert isinstance(replay, Replay)
    expected = {**vars(METHODS[name]), "capacity": 32, "batch_size": 4}
    assert vars(replay.method) == expected


@pytest.mark.filterwarnings("ignore:positive_above='mean'")
@pytest.mark.parametrize("name", OF_ONE_BATCH)
def test_method_of_one_batch_is_a_buffer_in_torchrls_group(at_once, name):
    buffer = instantiate(at_once.one[name])
    assert isinstance(buffer, SignalReplayBuffer)
    assert buffer.batch_size == 4
    if name in OF_SOME:
        assert buffer.sampler.alpha == 0.3


def test_methods_that_choose_their_batches_are_no_buffer_alone(composed):
    assert not any(("replay_buffer", f"signal_{name}") in CONFIGS for name in CHOOSY)
    with pytest.raises(Exception, match="method 'klper' needs policy and sigma"):
        instantiate(composed("+replay=klper").replay)


@pytest.mark.parametrize("name", METHODS)
def test_every_setting_is_a_field_with_the_default_of_the_method(name):
    config = OmegaConf.structured(CONFIGS["replay", name])
    for setting in fields(METHODS[name]):
        assert config[setting.name] == getattr(METHODS[name], setting.name)
