// Driver, safety filter and observation of a bundle in plain C++17, once per cycle, with the standard library alone.
// contract.hpp lies in the bundle. This is a third implementation of r2s/physics/safety_filter.py; a test compares them.
// Compile it without -ffast-math, which breaks the tests for NaN.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <string>

#include "contract.hpp"

namespace law {

namespace c = contract;
constexpr int n = contract::n;
using Vec = std::array<double, 3>;
using Mat = std::array<double, 9>;  // row by row
using Joints = std::array<double, n>;
using Square = std::array<Joints, n>;
using Command = std::array<double, c::actions + c::setpoints>;  // action, then the goal where the law needs it

inline Vec operator+(const Vec& a, const Vec& b) { return {a[0] + b[0], a[1] + b[1], a[2] + b[2]}; }
inline Vec operator-(const Vec& a, const Vec& b) { return {a[0] - b[0], a[1] - b[1], a[2] - b[2]}; }
inline Vec operator*(double s, const Vec& a) { return {s * a[0], s * a[1], s * a[2]}; }
inline double dot(const Vec& a, const Vec& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline Vec cross(const Vec& a, const Vec& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}
inline Vec operator*(const Mat& m, const Vec& a) {
  return {m[0] * a[0] + m[1] * a[1] + m[2] * a[2], m[3] * a[0] + m[4] * a[1] + m[5] * a[2],
          m[6] * a[0] + m[7] * a[1] + m[8] * a[2]};
}
inline Mat operator*(const Mat& a, const Mat& b) {
  Mat out{};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      for (int k = 0; k < 3; ++k) out[3 * i + j] += a[3 * i + k] * b[3 * k + j];
  return out;
}
inline Mat transposed(const Mat& m) { return {m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]}; }
inline Mat turned(const double* axis, double angle) {  // Rodrigues
  const double s = std::sin(angle), d = 1.0 - std::cos(angle), x = axis[0], y = axis[1], z = axis[2];
  return {1 - d * (y * y + z * z), d * x * y - s * z,         d * x * z + s * y,
          d * x * y + s * z,       1 - d * (x * x + z * z),   d * y * z - s * x,
          d * x * z - s * y,       d * y * z + s * x,         1 - d * (x * x + y * y)};
}
template <std::size_t size>
bool finite(const std::array<double, size>& x) {
  return std::all_of(x.begin(), x.end(), [](double v) { return std::isfinite(v); });
}

// Kinematics and dynamics without gravity.
struct Model {
  std::array<Mat, n> frame;
  std::array<Vec, n> origin, axis;
  Vec ee;

  void place(const Joints& q) {
    Mat r{1, 0, 0, 0, 1, 0, 0, 0, 1};
    Vec p{};
    for (int i = 0; i < n; ++i) {
      p = p + r * Vec{c::place[i][0], c::place[i][1], c::place[i][2]};
      Mat f;
      std::copy(c::frame[i], c::frame[i] + 9, f.begin());
      r = r * f * turned(c::axis[i], q[i]);
      frame[i] = r, origin[i] = p, axis[i] = r * Vec{c::axis[i][0], c::axis[i][1], c::axis[i][2]};
    }
    ee = p + r * Vec{c::hand[0], c::hand[1], c::hand[2]};
  }

  // The Jacobian's transpose times a force at the end effector.
  Joints pull(const Vec& force) const {
    Joints out;
    for (int j = 0; j < n; ++j) out[j] = dot(cross(axis[j], ee - origin[j]), force);
    return out;
  }

  // Mass matrix and Coriolis torque: Newton and Euler for the torque, the links' own energies for the matrix.
  void equations(const Joints& dq, Square& mass, Joints& bias) const {
    Vec omega{}, alpha{}, a{}, before{};
    mass = {}, bias = {};
    for (int k = 0; k < n; ++k) {
      if (k > 0) {
        const Vec way = origin[k] - before;
        a = a + cross(alpha, way) + cross(omega, cross(omega, way));
      }
      before = origin[k];
      const Vec spin = dq[k] * axis[k];
      alpha = alpha + cross(omega, spin);
      omega = omega + spin;
      const Vec own = frame[k] * Vec{c::com[k][0], c::com[k][1], c::com[k][2]};
      const Vec centre = origin[k] + own;
      const double* t = c::tensor[k];
      const Mat tensor = frame[k] * Mat{t[0], t[3], t[4], t[3], t[1], t[5], t[4], t[5], t[2]} * transposed(frame[k]);
      const Vec force = c::mass[k] * (a + cross(alpha, own) + cross(omega, cross(omega, own)));
      const Vec moment = tensor * alpha + cross(omega, tensor * omega);
      for (int j = 0; j <= k; ++j) {
        const Vec arm = centre - origin[j], moves = cross(axis[j], arm), turns = tensor * axis[j];
        bias[j] += dot(moves, force) + dot(axis[j], moment);
        for (int i = 0; i <= j; ++i) {
          const double m = c::mass[k] * dot(cross(axis[i], centre - origin[i]), moves) + dot(axis[i], turns);
          mass[i][j] += m;
          if (i != j) mass[j][i] += m;
        }
      }
    }
    for (int j = 0; j < n; ++j) mass[j][j] += c::rotors[j];
  }
};

// Solve the first k rows of a x = b in place, a symmetric and positive definite (Cholesky); a is lost.
inline void solve(Square& a, Joints& b, int k) {
  for (int i = 0; i < k; ++i) {
    for (int j = 0; j <= i; ++j) {
      for (int m = 0; m < j; ++m) a[i][j] -= a[i][m] * a[j][m];
      a[i][j] = i == j ? std::sqrt(a[i][i]) : a[i][j] / a[j][j];
    }
    for (int m = 0; m < i; ++m) b[i] -= a[i][m] * b[m];
    b[i] /= a[i][i];
  }
  for (int i = k - 1; i >= 0; --i) {
    for (int m = i + 1; m < k; ++m) b[i] -= a[m][i] * b[m];
    b[i] /= a[i][i];
  }
}

class Driver {
 public:
  enum Why { runs, silent, not_finite, outside, law_not_finite, requested };
  Model model;
  Joints effort{};  // Nm, the target torque after the low-pass
  Why why = runs;   // why the arm is being brought to rest

  explicit Driver(double soft_start_s = 0.0) : fade_(std::lround(soft_start_s / c::cycle_s)) {}

  // Bring the arm to rest, from the next cycle on; the first reason is kept.
  void stop() {
    if (why == runs) why = requested;
  }

  // Whether a motion that is being stopped is at rest, or its time is over.
  bool done() const { return why != runs && (rests_ || damped_ * c::cycle_s >= c::damp_s); }

  // The torque of this cycle; command: null without a new one. The model must be at q already.
  Joints operator()(const Joints& q, const Joints& dq, const Joints& tau_J_d, const Command* command) {
    const bool seen = finite(q) && finite(dq);
    silent_ = command && finite(*command) ? 0 : silent_ + 1;
    if (!silent_) command_ = *command, commanded_ = true;
    if (why == runs) why = reason(q, dq, seen);
    const bool stops = why != runs;
    damped_ += stops;
    rests_ = seen;
    double fastest = 0.0;
    for (int j = 0; j < n; ++j) {
      rests_ = rests_ && std::abs(dq[j]) < c::still;
      fastest = std::max(fastest, std::abs(dq[j]) / c::most[j]);
    }
    if (stops) {  // brake from the present speed, at once
      target_ = {};
      if (seen && damped_ == 1) share_ = std::min(1.0, fastest);
      share_ = std::max(0.0, share_ - c::cycle_s / c::brake_s);
      for (int j = 0; j < n && seen && share_ == 0.0; ++j)  // a spring against joints that a load moves on
        if (std::abs(dq[j]) > c::still) {
          if (dq[j] * held_[j] > 0.0) held_[j] -= std::copysign(std::min(c::release[j], std::abs(held_[j])), dq[j]);
          held_[j] = std::clamp(held_[j] - c::cycle_s * c::spring[j] * dq[j], -c::held_most[j], c::held_most[j]);
        }
    } else if (commanded_) {
      Joints wanted;
      c::control_law(q.data(), dq.data(), command_.data(), memory_.data(), wanted.data());
      if (finite(wanted))
        for (int j = 0; j < n; ++j) target_[j] = std::clamp(wanted[j], -c::asked[j], c::asked[j]);
      else
        why = law_not_finite, target_ = {};
    }
    ++cycle_;
    const double faded = cycle_ < fade_ ? static_cast<double>(cycle_) / fade_ : 1.0;
    for (int j = 0; j < n; ++j) {
      filtered_[j] += c::low_pass * (faded * target_[j] - filtered_[j]);
      effort[j] = stepped(filtered_[j], effort[j], j);
    }
    const Joints last = finite(tau_J_d) ? tau_J_d : sent_;
    Joints out{};
    if (seen) out = guard(q, dq);
    double part = 1.0;  // of the way from `last`, the same in all joints: the safe torques are a convex set
    for (int j = 0; j < n && seen; ++j) {
      out[j] = std::clamp(out[j], -c::tau_max[j], c::tau_max[j]);
      part = std::min(part, c::step[j] / std::max(c::step[j], std::abs(out[j] - last[j])));
    }
    for (int j = 0; j < n; ++j) sent_[j] = last[j] + std::clamp(part * (out[j] - last[j]), -c::step[j], c::step[j]);
    return sent_;
  }

 private:
  Command command_{};
  std::array<double, c::memories + 1> memory_{};  // C++ has no empty array
  Joints target_{}, filtered_{}, sent_{}, held_{};
  double share_ = 1.0;
  long fade_, cycle_ = 0, silent_ = 0, damped_ = 0;
  bool rests_ = false, commanded_ = false;

  static double stepped(double wanted, double last, int j) {
    return last + std::clamp(std::clamp(wanted, -c::tau_max[j], c::tau_max[j]) - last, -c::step[j], c::step[j]);
  }

  Why reason(const Joints& q, const Joints& dq, bool seen) const {
    if (silent_ * c::cycle_s > c::deadline_s) return silent;
    if (!seen) return not_finite;
    for (int j = 0; j < n; ++j)
      if (q[j] < c::q_stop_low[j] || q[j] > c::q_stop_high[j] || std::abs(dq[j]) > c::dq_stop[j]) return outside;
    return runs;
  }

  double allowed(double way, int j) const {  // rad/s of a joint that has so much way left
    double speed = std::min(share_ * c::most[j], c::approach * way);
    if (way > 0.0 && c::slowing[j] < INFINITY)
      speed = std::min(speed, std::sqrt(c::slowing[j] * way + c::offset[j] * c::offset[j]) - c::offset[j]);
    return speed;
  }

  Joints guard(const Joints& q, const Joints& dq) const {
    double near = 0.0;
    for (int j = 0; j < n; ++j) {
      near = std::max(near, (std::abs(dq[j]) / c::dq_max[j] - c::allowed) / (c::nothing - c::allowed));
      near = std::max(near, std::max(q[j] - c::q_high[j], c::q_low[j] - q[j]) / c::q_fade[j]);
    }
    Square mass, mobility;
    Joints bias, out, ddq, low, high, eaten{};
    model.equations(dq, mass, bias);
    for (int j = 0; j < n; ++j) {
      mass[j][j] += c::added[j];
      out[j] = (1.0 - std::min(near, 1.0)) * (effort[j] + held_[j]);
      if (c::friction[j] > 0.0 && c::added[j] > 0.0)
        eaten[j] = c::sure * c::friction[j] * std::abs(std::tanh(dq[j] / c::dry + out[j] / c::friction[j]));
      high[j] = c::rate * (allowed(c::q_high[j] - q[j], j) - dq[j]);
      low[j] = -c::rate * (allowed(q[j] - c::q_low[j], j) + dq[j]);
    }
    for (int j = 0; j < n; ++j) {
      Square root = mass;
      mobility[j] = {};
      mobility[j][j] = 1.0;
      solve(root, mobility[j], n);
    }
    bool within = true, still_within = true;
    for (int k = 0; k < n; ++k) {
      ddq[k] = 0.0;
      double wider = 0.0;
      for (int j = 0; j < n; ++j) {
        ddq[k] += mobility[k][j] * (out[j] - bias[j]);
        wider += std::abs(mobility[k][j]) * eaten[j];
      }
      within = within && low[k] <= ddq[k] && ddq[k] <= high[k];
      low[k] -= wider, high[k] += wider;  // by what friction may do to the joint
      still_within = still_within && low[k] <= ddq[k] && ddq[k] <= high[k];
    }
    if (within || still_within) return out;
    const Joints push = pushed(mobility, ddq, low, high);
    for (int j = 0; j < n; ++j) out[j] += push[j];
    return out;
  }

  // The torques that stops at the joints would add: block principal pivoting.
  static Joints pushed(const Square& mobility, const Joints& ddq, const Joints& low, const Joints& high) {
    std::array<int, n> side, other, at;
    Joints push{};
    for (int j = 0; j < n; ++j) side[j] = ddq[j] > high[j] ? 1 : ddq[j] < low[j] ? -1 : 0;
    for (int turn = 0; turn < c::rounds; ++turn) {
      int k = 0;
      Square own{};
      Joints x{};
      for (int j = 0; j < n; ++j)
        if (side[j]) at[k++] = j;
      for (int a = 0; a < k; ++a) {
        for (int b = 0; b < k; ++b) own[a][b] = mobility[at[a]][at[b]];
        x[a] = (side[at[a]] > 0 ? high : low)[at[a]] - ddq[at[a]];
      }
      solve(own, x, k);
      push = {};
      for (int a = 0; a < k; ++a) push[at[a]] = x[a];
      int changed = -1;
      for (int j = 0; j < n; ++j) {
        double reached = ddq[j];
        for (int m = 0; m < n; ++m) reached += mobility[j][m] * push[m];
        other[j] = side[j];
        if (side[j] * push[j] > 0.0) other[j] = 0;  // it would pull outwards
        else if (!side[j]) other[j] = reached > high[j] + c::exact ? 1 : reached < low[j] - c::exact ? -1 : 0;
        if (other[j] != side[j]) changed = j;
      }
      if (changed < 0) break;
      if (turn < c::pivots) side = other;
      else side[changed] = other[changed];
    }
    return push;
  }
};

// Why the training had no such goal (m, in the base frame); empty: it had.
inline std::string refused(const Vec& goal) {
  constexpr double rounding = 1e-6;  // m and rad, of a goal on the border
  const Vec way = goal - Vec{c::shoulder[0], c::shoulder[1], c::shoulder[2]};
  const double away = std::sqrt(dot(way, way)), azimuth = std::abs(std::atan2(goal[1], goal[0]));
  if (!finite(goal)) return "the goal is not finite";
  if (away < c::goal_nearest - rounding || away > c::goal_farthest + rounding)
    return "the goal is " + std::to_string(away) + " m from the shoulder; the training had " +
           std::to_string(c::goal_nearest) + " to " + std::to_string(c::goal_farthest) + " m";
  if (goal[2] < c::goal_lowest - rounding)
    return "the goal is at a height of " + std::to_string(goal[2]) + " m; the training had " +
           std::to_string(c::goal_lowest) + " m and more";
  if (azimuth > c::goal_azimuth + rounding)
    return "the goal is " + std::to_string(azimuth) + " rad to the side; the training had up to " +
           std::to_string(c::goal_azimuth) + " rad";
  return "";
}

// Why no motion of the training began in this state; empty: one did.
inline std::string refused(const Joints& q, const Joints& dq) {
  for (int j = 0; j < n; ++j) {
    const std::string joint = "joint " + std::to_string(j + 1);
    if (!(std::abs(q[j] - c::start[j]) <= c::start_within))
      return joint + " is at " + std::to_string(q[j]) + " rad; motions begin within " +
             std::to_string(c::start_within) + " rad of " + std::to_string(c::start[j]);
    if (!(std::abs(dq[j]) <= c::start_fastest))
      return joint + " moves at " + std::to_string(dq[j]) + " rad/s; motions begin at rest";
  }
  return "";
}

// The policy's observation; the model must be at q already.
inline std::array<float, c::observations> observe(const Driver& driver, const Joints& q, const Joints& dq,
                                                  const Vec& goal) {
  std::array<float, c::observations> out{};
  const Model& m = driver.model;
  const Vec error = goal - m.ee;
  const Joints pull = m.pull(error);
  const double* made[] = {q.data(), dq.data(), m.ee.data(), goal.data(), error.data(), driver.effort.data(),
                          pull.data()};  // in the order of contract::Of
  for (const c::Entry& e : c::entries)
    for (int k = 0; k < e.count; ++k) {
      const double x = made[e.of][k] / e.divided_by[k];
      out[e.begin + k] = static_cast<float>(e.tanh ? std::tanh(x) : x);
    }
  return out;
}

}  // namespace law
