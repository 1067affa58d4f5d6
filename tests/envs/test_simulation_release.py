"""A simulation that nobody holds any more is gone, whether or not anyone closed it."""

from __future__ import annotations

import gc

import pybullet

from mpfa_envs import NavigationEnv


def servers() -> int:
    return sum(bool(pybullet.isConnected(client)) for client in range(1000))


def test_environments_that_are_dropped_leave_no_server() -> None:
    gc.collect()
    before = servers()
    for seed in range(20):
        env = NavigationEnv(world="A")
        env.reset(seed=seed)
        del env
    gc.collect()
    assert servers() == before


def test_closing_again_spares_a_new_server_of_its_number() -> None:
    first = NavigationEnv(world="A")
    number = first.robots._batch.drives._simulations[0].client
    first.close()
    second = NavigationEnv(world="A")
    assert second.robots._batch.drives._simulations[0].client == number
    del first
    gc.collect()
    second.reset(seed=0)
    second.step([0.0, 0.0])
    second.close()
