"""Ask the operator whether an arm may move again after a stop."""

import sys
import termios
from typing import Protocol

from r2s.errors import UserError

CONSENT = "go on"  # the operator types this text to allow further motion


class Operator(Protocol):
    """Function that asks the person watching the arm for permission to move."""

    def __call__(self, reason: str, /) -> bool:
        """Return whether the arm may move again after a stop for the given reason."""
        ...


def find_operator(operator: Operator | str | None) -> Operator | None:
    """Return the operator function for the setting `operator`: 'terminal', a function, or None (no operator)."""
    if not isinstance(operator, str):
        return operator
    if operator != "terminal":
        raise UserError(f"operator: '{operator}'; allowed: terminal, where a person allows further motion")
    return operator_agrees


def operator_agrees(reason: str) -> bool:
    """Ask at the terminal whether a stopped arm may move again; without a terminal the answer is no."""
    if not sys.stdin.isatty():
        return False
    termios.tcflush(sys.stdin, termios.TCIFLUSH)  # discard input typed before the question
    question = f"check the arm; type '{CONSENT}' to let it move again, anything else ends the run:"
    print(
        f"\nthe arm was stopped: {reason}\n{question}", file=sys.stderr
    )  # `print` ends the line, because a pipeline relays only whole lines
    try:
        answer = input()
    except EOFError:
        return False
    return answer.strip() == CONSENT
