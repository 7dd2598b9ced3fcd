// Plans on a surface, for policies that press and wipe: a third implementation of r2s/tasks/surface_task.py.
// A plan is a file of NumPy, such as plan.npy of the bundle, with a row of contract::columns per control step.
#pragma once
#include <cstring>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "law.hpp"

namespace law {

struct Plan {
  std::vector<double> rows;

  // Read a plan; throws what is wrong with it.
  explicit Plan(const std::string& path) : rows(c::plan_rows * c::plan_columns) {
    std::ifstream file(path, std::ios::binary);
    char head[10];
    const unsigned char* size = reinterpret_cast<unsigned char*>(head) + 8;
    if (!file.read(head, sizeof head) || std::memcmp(head, "\x93NUMPY\x01", 7) != 0)
      throw std::runtime_error(path + " is no file of numpy.save");
    std::string words(size[0] + 256 * size[1], ' ');
    const std::string shape = "(" + std::to_string(c::plan_rows) + ", " + std::to_string(c::plan_columns) + ")";
    file.read(words.data(), static_cast<std::streamsize>(words.size()));
    if (words.find("'<f8'") == std::string::npos || words.find("'fortran_order': False") == std::string::npos ||
        words.find("'shape': " + shape) == std::string::npos)
      throw std::runtime_error(path + ": expected float64 of shape " + shape + ", row by row, got " +
                               words.substr(0, words.find('}') + 1));
    const auto bytes = static_cast<std::streamsize>(rows.size() * sizeof(double));
    if (!file.read(reinterpret_cast<char*>(rows.data()), bytes)) throw std::runtime_error(path + " ends too early");
    if (const std::string why = refused(); !why.empty()) throw std::runtime_error(path + ": " + why);
  }

  // The row of a control step; after the last one the target stays at the end.
  const double* row(long step) const { return rows.data() + std::min<long>(step, c::plan_rows - 1) * c::plan_columns; }
  const double* start() const { return row(0) + c::column_q; }

 private:
  static constexpr double rounding = 1e-6, near = 1e-3;  // m and N; m

  // Why the setpoint of row k, which commands the controller, contradicts the row's target, normal or force.
  // The target may be that of the middle of the control period, between this row's and the next one's.
  std::string contradicts(int k, const Vec& normal) const {
    const double *x = row(k), *next = row(k + 1), *given = x + c::column_setpoint, depth = x[c::column_depth];
    const std::string here = "row " + std::to_string(k);
    if (c::setpoints == 0) return "";
    const double after = k + 1 < c::plan_rows ? next[c::column_depth] : 2.0 * depth - row(k - 1)[c::column_depth];
    const Vec place{x[0], x[1], x[2]}, away = Vec{given[0], given[1], given[2]} - place;
    const double deep = -dot(away, normal);
    const Vec moved = Vec{next[0], next[1], next[2]} - place, aside = away + deep * normal;
    if (deep > std::max(depth, after) + rounding || deep < std::min(depth, after) - rounding ||
        std::sqrt(dot(aside, aside)) > std::sqrt(dot(moved, moved)) + rounding)
      return here + " has a setpoint with another target";
    if (c::setpoints >= 6 && length(given + 3) > c::plan_speed + rounding)
      return here + " has a target velocity of more than " + std::to_string(c::plan_speed) + " m/s";
    if (c::setpoints >= 15 && length(given + 12) > c::plan_feedforward + rounding)
      return here + " has a feedforward force of more than " + std::to_string(c::plan_feedforward) + " N";
    if (c::setpoints < 12) return "";  // only hybrid control: normal, force, measured force, whether measured
    for (int i = 0; i < 6; ++i) {
      const double planned = i < 3 ? normal[i] : x[c::column_force];
      const double asked = i > 3 ? 0.0 : c::own_contact ? c::contact[i] : planned;
      if (std::abs(given[6 + i] - asked) > rounding) return here + " has a setpoint with another normal or force";
    }
    return "";
  }

  static double length(const double* x) { return std::sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]); }

  std::string refused() const {
    const Vec point{c::plane_point[0], c::plane_point[1], c::plane_point[2]};
    const Vec normal{c::plane_normal[0], c::plane_normal[1], c::plane_normal[2]};
    for (int k = 0; k < c::plan_rows; ++k) {
      const double *x = row(k), force = x[c::column_force];
      const std::string here = "row " + std::to_string(k);
      const Vec away = Vec{x[0], x[1], x[2]} - point;
      const Vec turned = Vec{x[c::column_normal], x[c::column_normal + 1], x[c::column_normal + 2]} - normal;
      for (int i = 0; i < c::plan_columns; ++i)
        if (!std::isfinite(x[i])) return here + " is not finite";
      if (std::sqrt(dot(turned, turned)) > rounding) return here + " has another normal";
      if (std::abs(dot(away, normal)) > rounding) return here + " is off the nominal plane";
      if (std::sqrt(dot(away, away)) > c::plane_spread + rounding)
        return here + " is farther from the middle than the training's " + std::to_string(c::plane_spread) + " m";
      if (force < -rounding || force > c::plan_force + rounding)
        return here + " asks for " + std::to_string(force) + " N; the training had up to " +
               std::to_string(c::plan_force) + " N";
      if (x[c::column_depth] > c::plan_deep + rounding || x[c::column_depth] < -c::plan_high - rounding)
        return here + " has a target at a depth that the training did not have";
      if (const std::string why = contradicts(k, normal); !why.empty()) return why;
    }
    Joints q;
    std::copy_n(start(), n, q.begin());
    for (int j = 0; j < n; ++j)
      if (q[j] < c::q_stop_low[j] || q[j] > c::q_stop_high[j]) return "the start is beyond a limit";
    Model model;
    model.place(q);
    const double* x = row(0);
    const Vec off = model.point(c::tip) - Vec{x[0], x[1], x[2]} + x[c::column_depth] * normal;
    return std::sqrt(dot(off, off)) > near ? "the tip is not where the plan begins" : "";
  }
};

// Friction at v, as r2s/physics/friction.py has it; parameters in the order of the contract.
inline double friction_at(int j, double v) {
  const auto& f = c::own_friction;
  const auto logistic = [](double x) { return 1.0 / (1.0 + std::exp(-x)); };
  const auto sign = [](double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : 0.0; };
  if constexpr (c::family == 0)
    return f[0][j] * (logistic(f[1][j] * (v + f[2][j])) - logistic(f[1][j] * f[2][j])) + f[3][j] * v;
  const double soft = std::tanh(v / c::friction_sign), level = f[0][j] * (1.0 + sign(soft) * f[1][j]) * soft;
  if constexpr (c::family == 1) return level + f[2][j] * (1.0 + sign(v) * f[3][j]) * v;
  const double slow = v / f[4][j], rise = f[3][j] * (1.0 + sign(soft) * f[5][j]) * std::exp(-slow * slow);
  return level * (1.0 + rise) + f[2][j] * (1.0 + sign(v) * f[6][j]) * v;
}

// The estimated force of the surface against the normal, N, of the torque that the arm applied last.
inline double force_felt(const Model& m, const Joints& q, const Joints& dq, const Joints& tau, const Vec& normal) {
  const Vec gravity{c::gravity[0], c::gravity[1], c::gravity[2]};
  const Links own{c::own_mass, c::own_com, c::own_tensor};
  Square mass;
  Joints moving, held, external;
  m.equations(dq, mass, moving, gravity, own);
  m.equations(Joints{}, mass, held, gravity);
  for (int j = 0; j < n; ++j) {
    double torque = moving[j] - held[j] + friction_at(j, dq[j]) - c::own_offset[j] - c::drag_sin[j] * std::sin(q[j]);
    torque += c::load[j] * std::abs(held[j]) * std::tanh(dq[j] / c::load_sign) - c::drag_cos[j] * std::cos(q[j]);
    external[j] = tau[j] - torque;
  }
  const Vec place = m.point(c::tip);
  double a[3][4] = {};  // J J^T + regular, and J external
  for (int j = 0; j < n; ++j) {
    const Vec moves = cross(m.axis[j], place - m.origin[j]);
    for (int i = 0; i < 3; ++i) {
      a[i][3] += moves[i] * external[j];
      for (int k = 0; k < 3; ++k) a[i][k] += moves[i] * moves[k];
    }
  }
  for (int i = 0; i < 3; ++i) a[i][i] += c::regular;
  for (int i = 0; i < 3; ++i)
    for (int r = 0; r < 3; ++r) {
      if (r == i) continue;
      const double factor = a[r][i] / a[i][i];
      for (int k = i; k < 4; ++k) a[r][k] -= factor * a[i][k];
    }
  double out = 0.0;
  for (int i = 0; i < 3; ++i) out -= a[i][3] / a[i][i] * normal[i];
  return out;
}

// The policy's observation in a control step; the model must be at q already. limited: share of the last control period
// in which the safety filter changed the command.
inline std::array<float, c::observations> observe(const Driver& driver, const Joints& q, const Joints& dq,
                                                  const Joints& tau_J_d, const double* row, double limited) {
  std::array<float, c::observations> out{};
  const Model& m = driver.model;
  const Vec point{row[0], row[1], row[2]}, place = m.point(c::tip), error = point - m.ee, speed = m.velocity(place, dq);
  const Vec normal{row[c::column_normal], row[c::column_normal + 1], row[c::column_normal + 2]};
  const Vec offset = place - point, path_error = offset - dot(offset, normal) * normal;
  const Joints pull = m.pull(error);
  const double height = dot(offset, normal), rate = dot(speed, normal), force = row[c::column_force];
  const double missing = force - force_felt(m, q, dq, tau_J_d, normal), above = height + row[c::column_depth];
  const double* made[] = {q.data(),      dq.data(), m.ee.data(),  point.data(), error.data(),
                          driver.effort.data(), pull.data(), offset.data(), &height, speed.data(),
                          &rate,         &force,    &missing,     &above,       &limited,
                          path_error.data(), row + c::column_velocity};  // in the order of contract::Of
  for (const c::Entry& e : c::entries)
    for (int k = 0; k < e.count; ++k) {
      const double x = made[e.of][k] / e.divided_by[k];
      out[e.begin + k] = static_cast<float>(e.tanh ? std::tanh(x) : x);
    }
  return out;
}

}  // namespace law
