"""Ask the operator whether an arm may move again after a stop."""

import sys
import termios
from typing import Protocol

from r2s.errors import UserError

CONSENT = "go on"  # the operator types this to allow further motion


class Operator(Protocol):
    """A person who watches the arm."""

    def __call__(self, reason: str, /) -> bool:
        """Return whether the arm may move again after a stop with this reason."""
        ...


def find_operator(operator: Operator | str | None) -> Operator | None:
    """Return the operator for a setting, which is 'terminal', a function, or None."""
    if not isinstance(operator, str):
        return operator
    if operator != "terminal":
        raise UserError(f"operator: '{operator}'; allowed: terminal, where a person allows further motion")
    return operator_agrees


def operator_agrees(reason: str) -> bool:
    """Ask at the terminal whether a stopped arm may move again; without a terminal the answer is no."""
    if not sys.stdin.isatty():
        return False
    termios.tcflush(sys.stdin, termios.TCIFLUSH)  # input typed before the question does not count
    question = f"check the arm; type '{CONSENT}' to let it move again, anything else ends the run:"
    print(
        f"\nthe arm was stopped: {reason}\n{question}", file=sys.stderr
    )  # a whole line, which a pipeline shows at once
    try:
        answer = input()
    except EOFError:
        return False
    return answer.strip() == CONSENT
