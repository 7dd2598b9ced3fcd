"""Make contract.hpp: the contract's constants and control law in C++, for the control loop in examples/libfranka."""

import json
from collections.abc import Mapping
from typing import Any

from r2s.arm.clients.collision_thresholds import CAUTIOUS
from r2s.export.contract import MADE_OF, MORE_OF
from r2s.export.inverse_dynamics import FRICTION
from r2s.export.law import LINK
from r2s.export.push import PUSH_NUMBER, PUSH_VECTOR, STOPS

LOWEST = ("q_low", "q_stop_low")  # lower limits, in which null stands for minus infinity
PARAMETERS = 7  # number of parameters of the largest friction family


def header(contract: Mapping[str, Any], policy_sha256: str, law: str) -> str:
    """Return a C++17 header with arm model, safety filter, control law and observation.

    Args:
        contract: see contract.py. policy_sha256: digest of policy.onnx. law: C++ body of the law, `Controller.cpp`.
    """
    model, filter_, seen, rates, control = (contract[k] for k in ("model", "law", "observation", "rates", "control"))
    joints = ", ".join(json.dumps(name) for name in contract["joints"])
    words = {"robot": contract["robot"], "torque": contract["torque"]["convention"], "policy_sha256": policy_sha256}
    words["action"] = control["action"].replace(" ", "_")
    lines = ["// Written by r2s export from contract.json.", "#pragma once", "#include <cmath>", ""]
    lines += ["namespace contract {", "", f"constexpr int n = {len(contract['joints'])};"]
    lines += [f"constexpr const char* {name} = {json.dumps(word)};" for name, word in words.items()]
    lines += [f"constexpr const char* joints[n] = {{{joints}}};"]
    lines += [f"constexpr int cycle_hz = {rates['cycle_hz']}, policy_hz = {rates['policy_hz']};"]
    lines += [f"constexpr double start[n] = {_braced(contract['start']['q_rad'])};  // rad, at rest"]
    lines += [*_fences(contract), ""]
    lines += [_rows(name, [link[name] for link in model["links"]]) for name in LINK]
    lines += [f"constexpr double hand[3] = {_braced(model['hand_m'])};"]
    lines += [f"constexpr double rotors[n] = {_braced(model['rotors'])};", ""]
    for name, values in filter_["joint"].items():
        none = "-INFINITY" if name in LOWEST else "INFINITY"
        lines.append(f"constexpr double {name}[n] = {_braced(values, none)};  // {filter_['units'][name]}")
    lines += [f"constexpr double {name} = {value!r};" for name, value in filter_["number"].items()]
    on_surface = contract["goal"]["kind"] == "surface"
    begin, end = contract["goal"]["columns"]["setpoint"] if on_surface else (0, 3 * (control["setpoint"] == "goal"))
    sizes = {"actions": len(control["action_scale"]), "setpoints": end - begin, "memories": control["memory_size"]}
    goal = ", then the setpoint of the plan" if on_surface else ", then the goal in m" if end > begin else ""
    lines += _push(filter_["push"]) + _reflexes(filter_["reflexes"]) + (_surface(contract) if on_surface else [])
    lines += ["", f"// control={control['name']}: the command is the policy's action in {control['unit']}{goal}"]
    lines += [f"constexpr int {name} = {size};" for name, size in sizes.items()]
    parameters = control["parameters"] or [0.0]  # C++ has no empty array
    lines += [f"constexpr double parameters[{len(parameters)}] = {_braced(parameters)};"]
    lines += ["inline void control_law([[maybe_unused]] const double* q, [[maybe_unused]] const double* dq,"]
    lines += ["                        const double* command, [[maybe_unused]] double* memory, double* out) {"]
    lines += [f"  {line}" for line in law.splitlines()]
    lines += ["}", "", "// a term of an observation is tanh(of / divided_by), or without tanh"]
    sources = (*MADE_OF, *MORE_OF[contract["goal"]["kind"]])
    lines += [f"enum Of {{ {', '.join('of_' + word for word in sources)} }};"]
    lines += ["struct Entry { Of of; int begin, count; bool tanh; double divided_by[n > 3 ? n : 3]; };"]
    lines += [f"constexpr int observations = {seen['size']};", "constexpr Entry entries[] = {"]
    for e in seen["entries"]:
        begin, end = e["slice"]
        by = e["divided_by"] if isinstance(e["divided_by"], list) else [e["divided_by"] or 1.0] * (end - begin)
        lines.append(f"    {{of_{e['of']}, {begin}, {end - begin}, {str(e['tanh']).lower()}, {_braced(by)}}},")
    return "\n".join([*lines, "};", "", "}  // namespace contract", ""])


def _push(push: Mapping[str, Any] | None) -> list[str]:
    """Return the C++ constants of the push limit; without a push limit, all numbers are 0."""
    own: Mapping[str, Any] = push or {"stop": STOPS[0]} | dict.fromkeys(PUSH_NUMBER, 0.0) | dict.fromkeys(
        PUSH_VECTOR, [0.0] * 3
    )
    lines = ["", f"constexpr bool limits_pushes = {str(push is not None).lower()};", "namespace push {"]
    lines += [f"constexpr double {name} = {own[name]!r};" for name in PUSH_NUMBER]
    lines += [f"constexpr double {name}[3] = {_braced(own[name])};" for name in PUSH_VECTOR]
    lines += [f"enum Stop {{ {', '.join(STOPS)} }};", f"constexpr Stop stop = {own['stop']};", "}  // namespace push"]
    return lines


def _reflexes(given: Mapping[str, Any] | None) -> list[str]:
    """Return the C++ constants of a Franka arm's reflex thresholds; if `given` is None, use cautious thresholds."""
    own = given or {"torque_Nm": CAUTIOUS.torque, "force_N": CAUTIOUS.force}
    return [
        "// thresholds of the arm's reflexes",
        f"constexpr double collision_torque[7] = {_braced(list(own['torque_Nm']))};",
        f"constexpr double collision_force[6] = {_braced(list(own['force_N']))};",
    ]


def _surface(contract: Mapping[str, Any]) -> list[str]:
    """Return the C++ constants of plans on a surface and of the arm model for the estimate of contact force."""
    goal, model = contract["goal"], contract["control"]["model"]
    trained, family = goal["trained"], model["friction"]["family"]
    names, given = FRICTION[family], model["friction"]["parameters"]
    rows = [given[k] for k in names] + [[1.0] * len(contract["joints"])] * (PARAMETERS - len(names))
    lines = ["", "#define CONTRACT_ON_SURFACE", f"constexpr int plan_rows = {goal['shape'][0]};"]
    lines += [f"constexpr int plan_columns = {goal['shape'][1]};"]
    lines += [f"constexpr int column_{name} = {begin};" for name, (begin, _) in goal["columns"].items()]
    vectors = {"plane_point": trained["point_m"], "plane_normal": trained["normal"], "tip": goal["tip_m"]}
    vectors["gravity"] = model["gravity_m_per_s2"]
    lines += [f"constexpr double {name}[3] = {_braced(value)};" for name, value in vectors.items()]
    low, deepest = trained["depth_m"]
    numbers = {
        "plane_spread": trained["spread_m"],
        "plan_force": trained["force_N"][1],
        "plan_high": -low,
        "plan_deep": deepest,
        "plan_speed": trained["target_m_per_s"],
        "plan_feedforward": trained["feedforward_N"],
        "regular": goal["regular_m2"],
    }
    own = trained["contact"]
    lines += [f"constexpr bool own_contact = {str(own is not None).lower()};"]
    lines += [f"constexpr double contact[4] = {_braced(own or [0.0] * 4)};  // instead of the plan's"]
    numbers |= {
        "friction_sign": model["number"]["sign_rad_per_s"],
        "load_sign": model["number"]["load_sign_rad_per_s"],
    }
    lines += [f"constexpr double {name} = {value!r};" for name, value in numbers.items()]
    lines += [_rows(name, [link[name] for link in model["links"]], "own_") for name in ("mass", "com", "tensor")]
    lines += [f"constexpr double {k}[n] = {_braced(model[v])};" for k, v in OWN.items()]
    lines += [f"constexpr int family = {list(FRICTION).index(family)};  // {family}: {', '.join(names)}"]
    return [*lines, f"constexpr double own_friction[{PARAMETERS}][n] = {_braced(rows)};"]


OWN = {"own_offset": "offset_Nm", "load": "load", "drag_sin": "drag_sin_Nm", "drag_cos": "drag_cos_Nm"}


def _fences(contract: Mapping[str, Any]) -> list[str]:
    """Return C++ constants: limits of the start and of the goals, with infinity for limits that are null."""
    start, trained = contract["start"], contract["goal"].get("trained") or {}
    near, far = trained.get("shoulder_distance_m", (0.0, None))
    numbers = {"start_within": start["within_rad"], "start_fastest": start["fastest_rad_per_s"], "goal_nearest": near}
    numbers |= {"goal_farthest": far, "goal_azimuth": trained.get("azimuth_rad")}
    lines = [f"constexpr double {name} = {_braced(value)};" for name, value in numbers.items()]
    lines += [f"constexpr double goal_lowest = {_braced(trained.get('lowest_m'), '-INFINITY')};"]
    return [*lines, f"constexpr double shoulder[3] = {_braced(trained.get('shoulder_m', [0.0] * 3))};  // m"]


def _rows(name: str, values: list[Any], before: str = "") -> str:
    """Return a line of C++ that defines an array with a row per link; a frame has 9 numbers, a tensor has 6."""
    if name == "frame":
        values = [[x for row in frame for x in row] for frame in values]
    elif name == "tensor":
        values = [[t[0][0], t[1][1], t[2][2], t[0][1], t[0][2], t[1][2]] for t in values]
    wide = f"[{len(values[0])}]" if isinstance(values[0], list) else ""
    note = "  // xx yy zz xy xz yz" if name == "tensor" else ""
    return f"constexpr double {before}{name}[n]{wide} = {_braced(values)};{note}"


def _braced(values: Any, none: str = "INFINITY") -> str:
    if isinstance(values, list):
        return f"{{{', '.join(_braced(v, none) for v in values)}}}"
    return none if values is None else repr(values)
