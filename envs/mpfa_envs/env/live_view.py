"""Rendering of environments as pictures or in a live window."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mpfa_envs.scene.window import Window

RenderMode = Literal["human", "rgb_array"]
"""Rendering in a live window, or to a picture."""


class LiveView:
    """Checks the render mode of an environment, and opens its window."""

    metadata: dict[str, Any]
    render_mode: str | None
    _window: Window | None = None

    def _set_view(self, render_mode: RenderMode | None, shown_for: float) -> None:
        """Check the render mode; a picture stands for so long in real time [s]."""
        modes = self.metadata["render_modes"]
        if render_mode not in (None, *modes):
            names = " or ".join(map(repr, modes))
            raise ValueError(f"render_mode must be None or {names}, got {render_mode!r}")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(round(1 / shown_for), 1)}

    def _show(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """A picture; with ``render_mode="human"`` it goes to the window in its place."""
        if self.render_mode != "human":
            return picture
        if self._window is None:
            # Imported here because it needs pygame.
            from mpfa_envs.scene.window import Window

            self._window = Window(type(self).__name__, fps=self.metadata["render_fps"])
        self._window.show(picture)
        return None

    def _close_window(self) -> None:
        """Close the window, if there is one; the next picture opens another."""
        if self._window is not None:
            self._window.close()
            self._window = None
