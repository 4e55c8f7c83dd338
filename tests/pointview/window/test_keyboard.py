"""Presses, with their modifiers, however many a frame takes in at once."""

from __future__ import annotations

import pytest

glfw = pytest.importorskip("glfw")
keyboard = pytest.importorskip("pointview.window.keyboard")


class Heard:
    """What Dear ImGui would hear."""

    def __init__(self):
        self.calls = []

    def keyboard_callback(self, *arguments):
        self.calls.append(arguments)

    def char_callback(self, *arguments):
        self.calls.append(arguments)


@pytest.fixture
def keys(monkeypatch):
    monkeypatch.setattr(glfw, "set_key_callback", lambda window, call: None)
    monkeypatch.setattr(glfw, "set_char_callback", lambda window, call: None)
    monkeypatch.setattr(glfw, "get_key_name", lambda key, scancode: chr(key).lower() if key < 128 else None)
    return keyboard.Keyboard(None, Heard())


def press(keys, name, mods=0, action=glfw.PRESS):
    keys._on_key(None, getattr(glfw, f"KEY_{name}"), 0, action, mods)


def test_ctrl_counts_although_it_was_released_before_the_frame(keys):
    press(keys, "LEFT_CONTROL")
    press(keys, "Q", glfw.MOD_CONTROL)
    press(keys, "LEFT_CONTROL", glfw.MOD_CONTROL, glfw.RELEASE)
    press(keys, "Q", 0, glfw.RELEASE)
    assert keys.take(heard=True) == ({"quit"}, {"quit"})
    assert keys.take(heard=True) == (frozenset(), frozenset())


def test_a_key_is_held_until_it_is_released(keys):
    press(keys, "W", glfw.MOD_SHIFT)
    assert keys.take(heard=True) == ({"w"}, {"w", "shift"})
    assert keys.take(heard=True) == (frozenset(), {"w", "shift"})
    press(keys, "W", 0, glfw.RELEASE)
    assert keys.take(heard=True) == (frozenset(), frozenset())


def test_a_tap_between_two_frames_is_seen(keys):
    press(keys, "W")
    press(keys, "W", 0, glfw.RELEASE)
    assert keys.take(heard=True) == ({"w"}, {"w"})


def test_a_key_pressed_twice_counts_twice(keys):
    for _ in range(3):
        keys._on_char(None, ord("]"))
    press(keys, "T")
    taken = [keys.take(heard=True)[0] for _ in range(4)]
    assert taken == [{"]"}, {"]"}, {"]", "t"}, frozenset()]


def test_digits_of_both_pads_and_named_keys(keys):
    for name in ("3", "KP_5", "HOME", "F1"):
        press(keys, name)
    assert keys.take(heard=True)[0] == {"3", "5", "home", "f1"}


def test_letters_of_a_field_and_with_alt_are_no_commands(keys):
    press(keys, "C", glfw.MOD_ALT)
    assert keys.take(heard=True)[0] == frozenset()
    press(keys, "C")
    assert keys.take(heard=False)[0] == frozenset()
    assert keys.take(heard=True)[0] == frozenset()
    assert len(keys._renderer.calls) == 2
