"""Keys of the window, from glfw itself: a press counts with its modifiers, however long the frame takes that sees it.

Dear ImGui tells what is down at the time of a frame; where a frame takes long, Ctrl Q has come and gone by then, or
only Q is left. Letters are those of the person's keyboard layout, not of the place of the key.
"""

from __future__ import annotations

from typing import Any

import glfw

SPECIAL = {
    glfw.KEY_HOME: "home", glfw.KEY_TAB: "tab", glfw.KEY_F1: "f1", glfw.KEY_F12: "f12", glfw.KEY_ESCAPE: "escape",
    **{glfw.KEY_0 + digit: str(digit) for digit in range(10)},
    **{glfw.KEY_KP_0 + digit: str(digit) for digit in range(10)},
}  # fmt: skip

SYMBOLS = "[]?"
"""Characters that are commands, wherever the layout has them."""

COMMANDS = {"v": "paste", "q": "quit"}
"""What letters mean with Ctrl."""

OTHERS = glfw.MOD_ALT | glfw.MOD_SUPER


class Keyboard:
    """What went down since the last look, and what is down.

    Parameters
    ----------
    window : glfw window
    renderer : GlfwRenderer
        Of Dear ImGui, which hears of everything first.
    """

    def __init__(self, window: Any, renderer: Any) -> None:
        self._renderer = renderer
        self._pressed: list[str] = []
        self._down: dict[int, str] = {}
        self._shift = False
        glfw.set_key_callback(window, self._on_key)
        glfw.set_char_callback(window, self._on_char)

    def take(self, *, heard: bool) -> tuple[frozenset[str], frozenset[str]]:
        """Return keys that went down since the last call, and keys that are down or were.

        A key that went down twice is there again at the next call.

        Parameters
        ----------
        heard : bool
            False while a field of the panel takes the letters.
        """
        once = next((at for at, key in enumerate(self._pressed) if key in self._pressed[:at]), len(self._pressed))
        pressed, self._pressed = frozenset(self._pressed[:once]), self._pressed[once:]
        if not heard:
            return frozenset(), frozenset()
        return pressed, pressed | set(self._down.values()) | ({"shift"} if self._shift else set())

    def _on_key(self, window: Any, key: int, scancode: int, action: int, mods: int) -> None:
        self._renderer.keyboard_callback(window, key, scancode, action, mods)
        self._shift = bool(mods & glfw.MOD_SHIFT)
        if action == glfw.RELEASE:
            self._down.pop(key, None)
        elif action == glfw.PRESS and not mods & OTHERS:
            name = SPECIAL.get(key) or glfw.get_key_name(key, scancode) or ""
            if mods & glfw.MOD_CONTROL:
                self._pressed.extend([COMMANDS[name]] if name in COMMANDS else [])
            elif name and name not in SYMBOLS:
                self._pressed.append(name)
                self._down[key] = name

    def _on_char(self, window: Any, code: int) -> None:
        self._renderer.char_callback(window, code)
        if chr(code) in SYMBOLS:
            self._pressed.append(chr(code))
