"""Somebody at the keyboard of ``hypogoal label``: keys as pygame delivers them, on its driver without a screen."""

from __future__ import annotations

import threading
import time

import pygame

from hypogoal.cli import main


def label(keys: str, *arguments: str) -> int:
    """``hypogoal label`` while somebody presses these keys, then escape; needs SDL_VIDEODRIVER=dummy."""

    def press() -> None:
        until = time.monotonic() + 300  # a loaded machine takes long to begin
        while not (pygame.display.get_init() and pygame.display.get_surface()) and time.monotonic() < until:
            time.sleep(0.01)
        for key in [*keys.split(), "escape"]:
            code = pygame.key.key_code(key)
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=code, unicode="", mod=0, scancode=0))

    hand = threading.Thread(target=press, daemon=True)
    hand.start()
    code = main(["label", *arguments])
    hand.join()
    return code
