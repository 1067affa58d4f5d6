"""A live window, under SDL's driver that shows nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from gymnasium.error import DependencyNotInstalled

from mpfa_envs import NavigationEnv
from mpfa_envs.scene.scene import Window
from tests.envs.process import run

pygame = pytest.importorskip("pygame")


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    yield
    pygame.display.quit()


def on_screen() -> np.ndarray:
    """The picture in the open window, shape ``[height, width, 3]``."""
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)


def test_the_window_shows_what_a_recorder_would_see() -> None:
    live, recorded = (
        NavigationEnv(world="B", physics="kinematic", render_mode=mode)
        for mode in ("human", "rgb_array")
    )
    live.metadata["render_fps"] = 1000
    for env in (live, recorded):
        env.reset(seed=3)
    np.testing.assert_array_equal(on_screen(), recorded.render())
    for env in (live, recorded):
        env.step(np.ones(2, np.float32))
    np.testing.assert_array_equal(on_screen(), recorded.render())
    assert live.render() is None
    live.close()
    assert pygame.display.get_surface() is None
    live.close()


def test_a_room_of_a_generator_is_shown_as_well() -> None:
    env = NavigationEnv(world="rooms", physics="kinematic", render_mode="human")
    env.metadata["render_fps"] = 1000
    env.reset(seed=0)
    first = on_screen().copy()
    env.step(np.ones(2, np.float32))
    assert not np.array_equal(on_screen(), first)
    env.close()


def test_the_window_waits_until_a_picture_is_due() -> None:
    window = Window("test", fps=20)
    start = time.perf_counter()
    for _ in range(4):
        assert window.show(np.zeros((40, 60, 3), np.uint8))
    # The first one is due at once.
    assert time.perf_counter() - start > 3 / 20 - 0.02
    window.close()


def test_the_window_knows_the_keys_that_are_held() -> None:
    window = Window("test", fps=1000)
    picture = np.zeros((40, 60, 3), np.uint8)
    window.show(picture)
    for key in (pygame.K_UP, pygame.K_LEFT):
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))
    window.show(picture)
    assert window.keys == {"up", "left"} and window.pressed == ["up", "left"]
    pygame.event.post(pygame.event.Event(pygame.KEYUP, key=pygame.K_LEFT))
    window.show(picture)
    assert window.keys == {"up"} and window.pressed == []
    window.close()


@pytest.mark.parametrize("how", ["quit", "escape"])
def test_a_window_that_the_user_closes_shows_nothing_more(how: str) -> None:
    window = Window("test", fps=1000)
    picture = np.zeros((40, 60, 3), np.uint8)
    window.show(picture)
    escape = pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE)
    pygame.event.post(pygame.event.Event(pygame.QUIT) if how == "quit" else escape)
    assert not window.show(picture)
    assert not window.show(picture)
    assert pygame.display.get_surface() is None


def test_without_pygame_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    env = NavigationEnv(physics="kinematic", render_mode="human")
    with pytest.raises(DependencyNotInstalled, match="needs pygame: install the extra 'live'"):
        env.reset(seed=0)


def test_triton_can_be_imported_after_a_window_was_opened(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("triton")
    # Where there is neither screen nor setting, SDL picks a driver that renders in software.
    monkeypatch.delenv("SDL_VIDEODRIVER")
    run(
        "import numpy as np; from mpfa_envs.scene.scene import Window\n"
        "window = Window('test', fps=30); window.show(np.zeros((9, 9, 3), np.uint8)); import triton"
    )
