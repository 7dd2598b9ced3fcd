"""contract.hpp: what a C++ program needs of contract.json, as constants; examples/libfranka includes it."""

from collections.abc import Mapping
from typing import Any

from r2s.export.law import LINK
from r2s.export.runtime import MADE_OF

LOWEST = ("q_low", "q_stop_low")  # where null is minus infinity


def header(contract: Mapping[str, Any], policy_sha256: str) -> str:
    """Return a C++17 header: arrays of the model and of the law, and how an observation is made."""
    n, law, rates = len(contract["joints"]), contract["law"], contract["rates"]
    entries = contract["observation"]["entries"]
    lines = ["// Written by r2s export from contract.json; change nothing here.", "#pragma once", "#include <cmath>", ""]
    lines += ["namespace contract {", ""]
    lines += [f'constexpr const char* robot = "{contract["robot"]}";', f"constexpr int n = {n};"]
    lines += [f'constexpr const char* joints[n] = {{{", ".join(chr(34) + j + chr(34) for j in contract["joints"])}}};']
    lines += [f'constexpr const char* torque = "{contract["torque"]["convention"]}";']
    lines += [f'constexpr const char* policy_sha256 = "{policy_sha256}";']
    lines += [f"constexpr int cycle_hz = {rates['cycle_hz']}, policy_hz = {rates['policy_hz']};", ""]
    for name in LINK:
        values = [link[name] for link in contract["model"]["links"]]
        if name == "frame":
            values = [[x for row in frame for x in row] for frame in values]
        elif name == "tensor":
            values = [[t[0][0], t[1][1], t[2][2], t[0][1], t[0][2], t[1][2]] for t in values]
        wide = "" if name == "mass" else f"[{len(values[0])}]"
        note = "  // xx yy zz xy xz yz about com" if name == "tensor" else ""
        lines.append(f"constexpr double {name}[n]{wide} = {_braced(values)};{note}")
    lines += [f"constexpr double {k} = {_braced(contract['model'][j])};" for k, j in (("hand[3]", "hand_m"), ("rotors[n]", "rotors"))]
    lines += [""]
    for name, values in law["joint"].items():
        none = "-INFINITY" if name in LOWEST else "INFINITY"
        lines.append(f"constexpr double {name}[n] = {_braced(values, none)};  // {law['units'][name]}")
    lines += [f"constexpr double {name} = {_number(value)};" for name, value in law["number"].items()]
    lines += ["", "// an entry of an observation is tanh(of / divided_by), or without tanh", f"enum Of {{ {', '.join('of_' + w for w in MADE_OF)} }};"]
    lines += ["struct Entry { Of of; int begin, count; bool tanh; double divided_by[n > 3 ? n : 3]; };"]
    lines += [f"constexpr int observations = {contract['observation']['size']};", "constexpr Entry entries[] = {"]
    for e in entries:
        begin, end = e["slice"]
        by = e["divided_by"] if isinstance(e["divided_by"], list) else [e["divided_by"] or 1.0] * (end - begin)
        lines.append(f"    {{of_{e['of']}, {begin}, {end - begin}, {str(e['tanh']).lower()}, {_braced(by)}}},")
    return "\n".join([*lines, "};", "", "}  // namespace contract", ""])


def _braced(values: Any, none: str = "INFINITY") -> str:
    if isinstance(values, list):
        return f"{{{', '.join(_braced(v, none) for v in values)}}}"
    return none if values is None else _number(values)


def _number(value: float) -> str:
    return repr(value)
