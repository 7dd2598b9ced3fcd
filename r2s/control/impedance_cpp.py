"""The impedance laws (r2s/physics/impedance*.py) in C++17, for contract.hpp; a test compares C++ with Python."""

from r2s.physics import impedance, newton_euler

_FOUND = {k: v for module in (newton_euler, impedance) for k, v in vars(module).items() if k.isupper()}
_WHOLE = ", ".join(f"{name} = {value}" for name, value in _FOUND.items() if isinstance(value, int))
_CONSTANTS = f"enum {{ {_WHOLE} }};\n" + "\n".join(
    f"[[maybe_unused]] constexpr double {name} = {value!r};"
    for name, value in _FOUND.items()
    if isinstance(value, float)
)

_HELPERS = """
struct Pose { double r[9], p[3]; };
struct Law {
  static double least(double a, double b) { return b < a ? b : a; }
  static double most(double a, double b) { return b > a ? b : a; }
  static double follows() { return parameters[APPROACH] == 1.0 ? 0.0 : 1.0; }
  static const double* row(int i) { return parameters + HEAD + i * ROW; }
  static void rotate(const double* r, const double* v, double* o) {
    for (int i = 0; i < 3; ++i) o[i] = r[3 * i] * v[0] + r[3 * i + 1] * v[1] + r[3 * i + 2] * v[2];
  }
  static void product(const double* a, const double* b, double* o) {
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) o[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  }
  static void rotation(double x, double y, double z, double angle, double* o) {
    const double c = std::cos(angle), s = std::sin(angle), d = 1.0 - c;
    const double k[9] = {c + d * x * x, d * x * y - s * z, d * x * z + s * y, d * x * y + s * z, c + d * y * y,
                         d * y * z - s * x, d * x * z - s * y, d * y * z + s * x, c + d * z * z};
    for (int i = 0; i < 9; ++i) o[i] = k[i];
  }
  static void cross(const double* a, const double* b, double* o) {
    o[0] = a[1] * b[2] - a[2] * b[1], o[1] = a[2] * b[0] - a[0] * b[2], o[2] = a[0] * b[1] - a[1] * b[0];
  }
  static void arm_pose(const double* q, Pose* frames, double (*jacobian)[n], double* place) {
    double r[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1}, p[3] = {}, v[3], turned[9], k[9];
    for (int i = 0; i < n; ++i) {
      rotate(r, row(i), v);
      for (int c = 0; c < 3; ++c) p[c] += v[c];
      product(r, row(i) + FRAME, k);
      const double* axis = row(i) + AXIS;
      rotate(k, axis, v);
      rotation(axis[0], axis[1], axis[2], q[i], turned);
      product(k, turned, r);
      for (int c = 0; c < 3; ++c) jacobian[3 + c][i] = v[c], frames[i].p[c] = p[c];
      for (int c = 0; c < 9; ++c) frames[i].r[c] = r[c];
    }
    rotate(r, parameters + TIP, v);
    for (int c = 0; c < 3; ++c) place[c] = p[c] + v[c];
    for (int i = 0; i < n; ++i) {
      const double axis[3] = {jacobian[3][i], jacobian[4][i], jacobian[5][i]};
      for (int c = 0; c < 3; ++c) p[c] = place[c] - frames[i].p[c];
      cross(axis, p, v);
      for (int c = 0; c < 3; ++c) jacobian[c][i] = v[c];
    }
  }
  static void mass_matrix(const Pose* frames, const double (*jacobian)[n], double* mass) {
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) mass[i * n + j] = i == j ? row(i)[ROTOR] : 0.0;
    for (int k = 0; k < n; ++k) {
      double moved[n][3], centre[3], half[9], lever[3];
      const double* r = frames[k].r;
      rotate(r, row(k) + COM, centre);
      product(r, row(k) + TENSOR, half);
      for (int i = 0; i <= k; ++i) {
        const double axis[3] = {jacobian[3][i], jacobian[4][i], jacobian[5][i]};
        double local[3], spin[3];
        for (int c = 0; c < 3; ++c) lever[c] = centre[c] + frames[k].p[c] - frames[i].p[c];
        cross(axis, lever, moved[i]);
        for (int c = 0; c < 3; ++c) local[c] = r[c] * axis[0] + r[3 + c] * axis[1] + r[6 + c] * axis[2];
        rotate(half, local, spin);
        for (int j = 0; j <= i; ++j) {
          double moment = 0.0, force = 0.0;
          for (int c = 0; c < 3; ++c) moment += spin[c] * jacobian[3 + c][j], force += moved[i][c] * moved[j][c];
          mass[i * n + j] += row(k)[MASS] * force + moment;
          mass[j * n + i] = mass[i * n + j];
        }
      }
    }
  }
  static void invert(double* m, int size) {
    for (int k = 0; k < size; ++k) {
      const double pivot = 1.0 / m[k * size + k];
      m[k * size + k] = 1.0;
      for (int j = 0; j < size; ++j) m[k * size + j] *= pivot;
      for (int i = 0; i < size; ++i) {
        if (i == k) continue;
        const double factor = m[i * size + k];
        m[i * size + k] = 0.0;
        for (int j = 0; j < size; ++j) m[i * size + j] -= factor * m[k * size + j];
      }
    }
  }
  static void geometric_mean(const double* stiff, const double* mobility, double* out) {
    double scale = 0.0, other[n * n], p[n * n], o[n * n];
    for (int i = 0; i < n; ++i)
      for (int j = 0; j < n; ++j) scale += stiff[i * n + j] * mobility[j * n + i] / n;
    for (int i = 0; i < n * n; ++i) out[i] = stiff[i] / scale, other[i] = mobility[i];
    for (int round = 0; round < ROUNDS; ++round) {
      for (int i = 0; i < n * n; ++i) p[i] = out[i], o[i] = other[i];
      invert(p, n);
      invert(o, n);
      for (int i = 0; i < n * n; ++i) out[i] = 0.5 * (out[i] + o[i]), other[i] = 0.5 * (other[i] + p[i]);
    }
    for (int i = 0; i < n * n; ++i) out[i] *= std::sqrt(scale);
  }
  static double factor(double s, double limit) { return s <= limit ? 1.0 : std::sqrt(limit / s); }
  static double energy(double s, double limit) { return s <= limit ? s : 2.0 * factor(s, limit) * s - limit; }
  static void refill(const double* q, double* memory, int at) {
    if (memory[BEGUN] == 0.0) {
      memory[BEGUN] = 1.0, memory[LEVEL] = parameters[FILL];
      for (int j = 0; j < n; ++j) memory[at + MEAN * n + j] = memory[at + ANCHOR * n + j] = q[j];
    } else {
      for (int j = 0; j < n; ++j)
        memory[LEVEL] -= memory[at + DAMPED * n + j] * (q[j] - memory[at + BEFORE * n + j] -
                                                        follows() * memory[at + j] * parameters[CYCLE_S]);
    }
    memory[LEVEL] = least(most(memory[LEVEL], 0.0), parameters[TANK]);
  }
  static double friction_at(double v, const double* joint, double load) {
    const double* table = joint + (v >= 0.0 ? FRICTION : FRICTION + NODES);
    const double part = v >= 0.0 ? load : -load;
    double low = 0.0, level = 0.0, high = FIRST_DQ, top = table[0] + part;
    for (int k = 0; std::abs(v) > high && k < NODES - 1;) {
      low = high, level = top, high *= 4.0;
      top = table[++k] + part;
    }
    return level + (top - level) * (std::abs(v) - low) / (high - low);
  }
  static double friction_ahead(double v, double q, const double* joint, double load, double* mean) {
    double &anchor = mean[(ANCHOR - MEAN) * n], &z = mean[(DEFLECTION - MEAN) * n];
    const double speed = (q - *mean) / SETTLE_S, distance = joint[PRESLIDING], fast = most(std::abs(v), FIRST_DQ);
    *mean += parameters[CYCLE_S] * speed;
    const double moved = *mean - anchor;
    if (distance > 0.0) {
      if (std::abs(moved) > most(STEP * distance, ENCODER)) {
        const double side = moved > 0.0 ? 1.0 : -1.0;
        z = side + (z - side) * std::exp(-std::abs(moved) / distance);
        anchor = *mean;
      }
      const double side = z >= 0.0 ? 1.0 : -1.0, now = most(std::abs(speed), FIRST_DQ);
      const double level = std::abs(friction_at(side * fast, joint, load));
      return z * least(level, std::abs(friction_at(side * now, joint, load)));
    }
    if (parameters[APPROACH] == 1.0) return friction_at(v, joint, load);
    const double level = std::abs(friction_at(v >= 0.0 ? fast : -fast, joint, load));
    const double beyond = most(std::abs(v >= 0.0 ? joint[EDGES + 1] : joint[EDGES]) - level, 0.0);
    return (level + beyond * most(1.0 - std::abs(speed) / REST_DQ, 0.0)) * std::tanh(v / DIRECTION_DQ);
  }
  static double weight_about(double mass, const double* moment, const double* p, const double (*jacobian)[n], int j) {
    double lever[3], v[3];
    for (int c = 0; c < 3; ++c) lever[c] = moment[c] - mass * p[c];
    cross(lever, parameters + GRAVITY, v);
    return jacobian[3][j] * v[0] + jacobian[4][j] * v[1] + jacobian[5][j] * v[2];
  }
  static void feedforward(const double* q, const Pose* frames, const double (*jacobian)[n], double* memory, int at,
                          double* out) {
    double error[4] = {}, all[4] = {}, v[3];  // mass and first moment of what a joint carries
    for (int j = n - 1; j >= 0; --j) {
      const double *p = row(j), *place = frames[j].p;
      rotate(frames[j].r, p + MOMENT_ERROR, v);
      error[3] += p[MASS_ERROR], all[3] += p[MASS];
      for (int c = 0; c < 3; ++c) error[c] += v[c] + p[MASS_ERROR] * place[c];
      rotate(frames[j].r, p + COM, v);
      for (int c = 0; c < 3; ++c) all[c] += p[MASS] * (v[c] + place[c]);
      const double load = p[LOAD] * std::abs(weight_about(all[3], all, place, jacobian, j));
      out[j] -= weight_about(error[3], error, place, jacobian, j);
      out[j] -= p[OFFSET] + p[DRAG] * std::sin(q[j]) + p[DRAG + 1] * std::cos(q[j]);
      out[j] += friction_ahead(memory[at + j], q[j], p, load, memory + at + MEAN * n + j);
    }
  }
"""

_JOINT = """
};
const int at = STIFFNESS + n, target = int(parameters[TARGET_AT]);
const int shift = int(parameters[DISPLACED]), stiff = int(parameters[STIFFNESS_AT]);
const bool begins = memory[BEGUN] == 0.0;
double* K = memory + STIFFNESS;
double error[n], asked[n], place[3], jacobian[6][n], mass[n * n], raised = 0.0, share = 1.0;
Law::refill(q, memory, at);
for (int j = 0; j < n; ++j) {
  const double* p = Law::row(j);
  error[j] = (target >= 0 ? command[target + j] : p[HOME]) - q[j] + (shift >= 0 ? command[shift + j] : 0.0);
  memory[at + j] = target >= 0 ? command[target + n + j] : 0.0;
  asked[j] = stiff < 0 ? p[K_JOINT] : Law::least(Law::most(command[stiff + j], p[K_JOINT + 1]), p[K_JOINT + 2]);
  if (begins) K[j] = asked[j];
}
for (bool pays = false; !pays;) {
  raised = 0.0;
  for (int j = 0; j < n; ++j) {
    out[j] = asked[j] <= K[j] ? asked[j] : K[j] + share * (asked[j] - K[j]);
    const double s = 0.5 * error[j] * error[j], limit = Law::row(j)[JOINT_LIMIT];
    raised += Law::energy(s * out[j], limit) - Law::energy(s * K[j], limit);
  }
  pays = raised <= memory[LEVEL] || share == 0.0;
  share = share > SMALLEST ? 0.5 * share : 0.0;
}
memory[LEVEL] = Law::least(memory[LEVEL] - raised, parameters[TANK]);
Pose frames[n];
Law::arm_pose(q, frames, jacobian, place);
double* D = memory + at + ROWS * n;
if (memory[SINCE] == 0.0) {
  double stiffness[n * n] = {};
  Law::mass_matrix(frames, jacobian, mass);
  Law::invert(mass, n);
  for (int j = 0; j < n; ++j) stiffness[j * n + j] = out[j];
  Law::geometric_mean(stiffness, mass, D);
}
for (int j = 0; j < n; ++j) {
  double damping = 0.0;
  K[j] = out[j];
  for (int k = 0; k < n; ++k) damping -= parameters[RATIO] * D[j * n + k] * (dq[k] - memory[at + k]);
  out[j] = K[j] * error[j] * Law::factor(0.5 * K[j] * error[j] * error[j], Law::row(j)[JOINT_LIMIT]) + damping;
  memory[at + DAMPED * n + j] = damping, memory[at + BEFORE * n + j] = q[j];
}
Law::feedforward(q, frames, jacobian, memory, at, out);
memory[SINCE] = memory[SINCE] + 1.0 < parameters[HOLD] ? memory[SINCE] + 1.0 : 0.0;
"""

_CARTESIAN = """
  static double task_energy(const double* K, const double* error, double tilt) {
    const double s = 0.5 * (K[0] * error[0] * error[0] + K[1] * error[1] * error[1] + K[2] * error[2] * error[2]);
    return energy(s, parameters[FORCE_LIMIT]) + energy(K[3] * tilt, parameters[MOMENT_LIMIT]);
  }
  static void task_stiffness(const double* command, const double* error, double tilt, bool begins, double* memory) {
    double *K = memory + STIFFNESS, asked[SPRINGS], changed[SPRINGS], raised = 0.0, share = 1.0;
    const int at = int(parameters[STIFFNESS_AT]), given = parameters[TASK_AXES] == 6.0 ? 4 : 3;
    for (int k = 0; k < SPRINGS; ++k) {
      asked[k] = parameters[K_DEFAULT + k];
      if (at >= 0 && k < given)
        asked[k] = least(most(command[at + k], parameters[K_LOW + k]), parameters[K_HIGH + k]);
      if (begins) K[k] = asked[k];
    }
    const double before = task_energy(K, error, tilt);
    for (bool pays = false; !pays;) {
      for (int k = 0; k < SPRINGS; ++k) changed[k] = asked[k] <= K[k] ? asked[k] : K[k] + share * (asked[k] - K[k]);
      raised = task_energy(changed, error, tilt) - before;
      pays = raised <= memory[LEVEL] || share == 0.0;
      share = share > SMALLEST ? 0.5 * share : 0.0;
    }
    memory[LEVEL] = least(memory[LEVEL] - raised, parameters[TANK]);
    for (int k = 0; k < SPRINGS; ++k) K[k] = changed[k];
  }
  static double rotation_error(const double* r, const double* command, double* error) {
    double v[3] = {}, turned[9], goal[9], trace = 0.0;
    if (parameters[DISPLACED] >= 0.0)
      for (int c = 0; c < 3; ++c) v[c] = command[int(parameters[DISPLACED]) + 3 + c];
    if (parameters[TARGET_SIZE] >= 9.0)
      for (int c = 0; c < 3; ++c) v[c] += command[int(parameters[TARGET_AT]) + 6 + c];
    const double angle = std::sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), w = angle > 0.0 ? 1.0 / angle : 0.0;
    rotation(v[0] * w, v[1] * w, v[2] * w, angle, turned);
    product(turned, parameters + HOME_AXES, goal);
    for (int c = 0; c < 3; ++c) error[c] = 0.0;
    for (int k = 0; k < 3; ++k) {
      const double a[3] = {r[k], r[3 + k], r[6 + k]}, b[3] = {goal[k], goal[3 + k], goal[6 + k]};
      double o[3];
      cross(a, b, o);
      for (int c = 0; c < 3; ++c) error[c] += 0.5 * o[c], trace += a[c] * b[c];
    }
    return most(0.5 * (3.0 - trace), 0.0);
  }
  static void update(const double* velocity, const Pose* frames, const double (*jacobian)[n], double* memory) {
    constexpr int a = AXES, at = STIFFNESS + SPRINGS;
    const double* K = memory + STIFFNESS;
    double *D = memory + at + ROWS * n, *N = D + n * n, mass[n * n], mobility[n * n], W[a * a], G[a][n], across[n];
    mass_matrix(frames, jacobian, mass);
    for (int i = 0; i < n * n; ++i) mobility[i] = mass[i];
    invert(mobility, n);
    for (int i = 0; i < a; ++i) {
      for (int j = 0; j < n; ++j) {
        across[j] = 0.0;
        for (int k = 0; k < n; ++k) across[j] += jacobian[i][k] * mobility[k * n + j];
      }
      for (int k = 0; k < a; ++k) {
        W[i * a + k] = i == k ? MOBILITY : 0.0;
        for (int j = 0; j < n; ++j) W[i * a + k] += across[j] * jacobian[k][j];
      }
    }
    invert(W, a);
    for (int i = 0; i < a; ++i)
      for (int j = 0; j < n; ++j) {
        G[i][j] = 0.0;
        for (int k = 0; k < n; ++k) {
          double along = 0.0;
          for (int c = 0; c < a; ++c) along += W[i * a + c] * jacobian[c][k];
          G[i][j] += along * mobility[k * n + j];
        }
      }
    for (int i = 0; i < n; ++i) {
      memory[at + i] = G[0][i] * velocity[0] + G[1][i] * velocity[1] + G[2][i] * velocity[2];
      for (int j = 0; j < n; ++j) {
        N[i * n + j] = i == j ? 1.0 : 0.0;
        for (int k = 0; k < a; ++k) N[i * n + j] -= jacobian[k][i] * G[k][j];
      }
    }
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j) {
        double& stiff = mass[i * n + j];
        stiff *= FREE * FREE;
        for (int k = 0; k < n; ++k) stiff += N[i * n + k] * row(k)[K_JOINT] * N[j * n + k];
        for (int k = 0; k < a; ++k) stiff += jacobian[k][i] * K[k < 3 ? k : 3] * jacobian[k][j];
        mass[j * n + i] = stiff;
      }
    geometric_mean(mass, mobility, D);
  }
  static double normal_force(const double* command, int shift, double* memory) {
    const double* contact = command + int(parameters[TARGET_AT]) + int(parameters[TARGET_SIZE]);
    const double limit = parameters[INTEGRAL_MAX], all = parameters[FORCE_MAX];
    double asked = contact[3];
    if (shift >= 0)
      for (int k = 0; k < 3; ++k) asked -= parameters[K_DEFAULT] * contact[k] * command[shift + k];
    asked = least(most(asked, 0.0), all);
    if (contact[5] > 0.0) {
      const double missing = asked - contact[4], total = asked + memory[INTEGRAL];
      if ((missing > 0.0 && total < all) || (missing < 0.0 && total > 0.0)) {
        memory[INTEGRAL] += parameters[RATE] * parameters[CYCLE_S] * missing;
        memory[INTEGRAL] = least(most(memory[INTEGRAL], -limit), limit);
      }
    }
    return least(most(asked + memory[INTEGRAL], 0.0), all);
  }
  static void slide(const double* normal, const double* error, const double* dq, const double (*jacobian)[n],
                    double* velocity, double* memory, double* aside) {
    double up = 0.0, rises = 0.0, fast = SLIDING * SLIDING, along[3], side[3];
    for (int k = 0; k < 3; ++k) {
      up += velocity[k] * normal[k];
      for (int j = 0; j < n; ++j) rises += normal[k] * jacobian[k][j] * dq[j];
    }
    for (int k = 0; k < 3; ++k) along[k] = velocity[k] - up * normal[k];
    for (int k = 0; k < 3; ++k) fast += along[k] * along[k], rises -= memory[SLOPE + k] * along[k];
    const double learns = SLOPE_RATE * parameters[CYCLE_S] * rises / fast, limit = parameters[INTEGRAL_MAX];
    for (int k = 0; k < 3; ++k) {
      memory[SLOPE + k] += learns * along[k];
      for (int c = 0; c < 3; ++c) velocity[c] += memory[SLOPE + k] * along[k] * normal[c];
    }
    for (int k = 0; k < 3; ++k) along[k] /= std::sqrt(fast), side[k] = along[k];
    for (int i = 0; i < 2; ++i) {
      double& sum = memory[ACROSS + i];
      for (int k = 0; k < 3; ++k)
        sum += parameters[CYCLE_S] * parameters[RATE] * parameters[K_DEFAULT] * error[k] * side[k];
      sum = least(most(sum, -limit), limit);
      for (int k = 0; k < 3; ++k) aside[k] += sum * side[k];
      cross(normal, along, side);
    }
  }
};
constexpr int at = STIFFNESS + SPRINGS;
const int shift = int(parameters[DISPLACED]), target = int(parameters[TARGET_AT]);
const bool begins = memory[BEGUN] == 0.0, pushes = parameters[HYBRID] > 0.0, slides = parameters[APPROACH] == SLIDES;
double place[3], jacobian[6][n], error[3], velocity[3] = {}, aside[3] = {}, wrench[6] = {}, along = 0.0;
Pose frames[n];
Law::arm_pose(q, frames, jacobian, place);
Law::refill(q, memory, at);
for (int k = 0; k < 3; ++k) error[k] = command[target + k] - place[k] + (shift >= 0 ? command[shift + k] : 0.0);
const double* normal = command + target + int(parameters[TARGET_SIZE]);
for (int k = 0; k < (parameters[TARGET_SIZE] >= 6.0 ? 3 : 0); ++k) {
  velocity[k] = command[target + 3 + k];
  if (slides) error[k] += parameters[CYCLE_S] * (memory[SINCE] - 0.5 * parameters[HOLD]) * velocity[k];
}
if (pushes) {
  along = error[0] * normal[0] + error[1] * normal[1] + error[2] * normal[2];
  for (int k = 0; k < 3; ++k) error[k] -= along * normal[k];
  if (slides) Law::slide(normal, error, dq, jacobian, velocity, memory, aside);
}
const double tilt = AXES == 6 ? Law::rotation_error(frames[n - 1].r, command, wrench + 3) : 0.0;
Law::task_stiffness(command, error, tilt, begins, memory);
const double* K = memory + STIFFNESS;
const double s = 0.5 * (K[0] * error[0] * error[0] + K[1] * error[1] * error[1] + K[2] * error[2] * error[2]);
const double force = Law::factor(s, parameters[FORCE_LIMIT]);
const double moment = Law::factor(K[3] * tilt, parameters[MOMENT_LIMIT]);
for (int k = 0; k < 3; ++k) wrench[k] = force * K[k] * error[k], wrench[3 + k] *= moment * K[3];
if (pushes) {
  double push = Law::normal_force(command, shift, memory);
  if (parameters[APPROACH] > 0.0) push = Law::least(push, Law::most(-parameters[K_DEFAULT] * along, 0.0));
  along = push + wrench[0] * normal[0] + wrench[1] * normal[1] + wrench[2] * normal[2];
  for (int k = 0; k < 3; ++k) wrench[k] -= along * normal[k];
  for (int k = 0; k < (slides ? 3 : 0); ++k) wrench[k] += normal[6 + k] + aside[k] + push * memory[SLOPE + k];
}
if (memory[SINCE] == 0.0) Law::update(velocity, frames, jacobian, memory);
const double *D = memory + at + ROWS * n, *N = D + n * n;
for (int j = 0; j < n; ++j) {
  double damping = 0.0, torque = 0.0;
  for (int k = 0; k < n; ++k) {
    damping -= parameters[RATIO] * D[j * n + k] * (dq[k] - Law::follows() * memory[at + k]);
    torque += N[j * n + k] * Law::row(k)[K_JOINT] * (Law::row(k)[HOME] - q[k]);
  }
  for (int k = 0; k < AXES; ++k) torque += jacobian[k][j] * wrench[k];
  out[j] = torque + damping;
  memory[at + DAMPED * n + j] = damping, memory[at + BEFORE * n + j] = q[j];
}
Law::feedforward(q, frames, jacobian, memory, at, out);
memory[SINCE] = memory[SINCE] + 1.0 < parameters[HOLD] ? memory[SINCE] + 1.0 : 0.0;
"""

JOINT = _CONSTANTS + _HELPERS + _JOINT
CARTESIAN = _CONSTANTS + "\nconstexpr int AXES = int(parameters[TASK_AXES]);" + _HELPERS + _CARTESIAN
