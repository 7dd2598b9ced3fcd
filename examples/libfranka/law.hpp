// Driver, safety filter and observation of a bundle in plain C++17, once per cycle, with the standard library alone.
// contract.hpp lies in the bundle. This is a third implementation of r2s/physics/safety_filter.py; a test compares them.
// Compile it without -ffast-math, which breaks the tests for NaN.
#pragma once
#include <string>

#include "model.hpp"
#include "push.hpp"

namespace law {

using Command = std::array<double, c::actions + c::setpoints>;  // action, then what else the law needs

class Driver {
 public:
  enum Why { runs, silent, not_finite, outside, law_not_finite, requested };
  Model model;
  Joints effort{};  // Nm, the target torque after the low-pass
  Why why = runs;   // why the arm is being brought to rest
  long limited = 0;  // cycles in which the safety filter changed the command

  explicit Driver(double soft_start_s = 0.0) : fade_(std::lround(soft_start_s / c::cycle_s)) {}

  // Bring the arm to rest, from the next cycle on; the first reason is kept.
  void stop() {
    if (why == runs) why = requested;
  }

  // Whether a motion that is being stopped is at rest, or its time is over.
  bool done() const { return why != runs && damped_ > 0 && (rests_ || damped_ * c::cycle_s >= c::damp_s); }

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
    Square mass{};
    Joints bias{};
    if (seen) model.equations(dq, mass, bias);
    if (seen && c::limits_pushes) push_.see(model, dq, mass, bias);
    if (stops) {  // brake from the present speed, at once
      double needs = 0.0;
      target_ = {};
      if (seen && damped_ == 1) share_ = std::min(1.0, fastest);
      if (seen && c::limits_pushes && why != not_finite && why != outside) {
        needs = push_.stop(held_, damped_, target_);
        for (int j = 0; j < n; ++j) target_[j] = std::clamp(target_[j], -c::asked[j], c::asked[j]);
        rests_ = rests_ && push_.phase == Push::over;
      }
      share_ = std::max(needs, share_ - c::cycle_s / c::brake_s);
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
    if (seen) out = guard(q, dq, last, mass, bias);
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
  Push push_;
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

  Joints guard(const Joints& q, const Joints& dq, const Joints& last, Square& mass, const Joints& bias) {
    double near = 0.0;
    for (int j = 0; j < n; ++j) {
      near = std::max(near, (std::abs(dq[j]) / c::dq_max[j] - c::allowed) / (c::nothing - c::allowed));
      near = std::max(near, std::max(q[j] - c::q_high[j], c::q_low[j] - q[j]) / c::q_fade[j]);
    }
    Square mobility;
    Joints out, low, high;
    for (int j = 0; j < n; ++j) {
      mass[j][j] += c::added[j];
      out[j] = (1.0 - std::min(near, 1.0)) * (effort[j] + held_[j]);
      high[j] = c::rate * (allowed(c::q_high[j] - q[j], j) - dq[j]);
      low[j] = -c::rate * (allowed(q[j] - c::q_low[j], j) + dq[j]);
    }
    for (int j = 0; j < n; ++j) {
      Square root = mass;
      mobility[j] = {};
      mobility[j][j] = 1.0;
      solve(root, mobility[j], n);
    }
    const auto joints = [&](Joints& tau, const Joints& of) { return bounded(tau, dq, of, mobility, low, high); };
    const bool changed = c::limits_pushes ? push_.limit(out, last, joints) : joints(out, bias);
    limited += changed || 1.0 - std::min(near, 1.0) < 1.0;
    return out;
  }

  // Change a torque to the nearest under which no joint accelerates beyond its bounds; return whether it is another.
  static bool bounded(Joints& tau, const Joints& dq, const Joints& bias, const Square& mobility, Joints low,
                      Joints high) {
    Joints ddq, eaten{};
    for (int j = 0; j < n; ++j)
      if (c::friction[j] > 0.0 && c::added[j] > 0.0)
        eaten[j] = c::sure * c::friction[j] * std::abs(std::tanh(dq[j] / c::dry + tau[j] / c::friction[j]));
    bool within = true, still_within = true;
    for (int k = 0; k < n; ++k) {
      ddq[k] = 0.0;
      double wider = 0.0;
      for (int j = 0; j < n; ++j) {
        ddq[k] += mobility[k][j] * (tau[j] - bias[j]);
        wider += std::abs(mobility[k][j]) * eaten[j];
      }
      within = within && low[k] <= ddq[k] && ddq[k] <= high[k];
      low[k] -= wider, high[k] += wider;  // by what friction may do to the joint
      still_within = still_within && low[k] <= ddq[k] && ddq[k] <= high[k];
    }
    if (within || still_within) return false;
    const Joints push = stops(mobility, ddq, low, high);
    for (int j = 0; j < n; ++j) tau[j] += push[j];
    return true;
  }

  // The torques that stops at the joints would add: block principal pivoting.
  static Joints stops(const Square& mobility, const Joints& ddq, const Joints& low, const Joints& high) {
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

// Why no motion of the training began at these angles; empty: one did.
inline std::string refused(const Joints& q) {
  for (int j = 0; j < n; ++j)
    if (!(std::abs(q[j] - c::start[j]) <= c::start_within))
      return "joint " + std::to_string(j + 1) + " is at " + std::to_string(q[j]) + " rad; motions begin within " +
             std::to_string(c::start_within) + " rad of " + std::to_string(c::start[j]);
  return "";
}

// Why no motion of the training began at these speeds; empty: one did.
inline std::string moves(const Joints& dq) {
  for (int j = 0; j < n; ++j)
    if (!(std::abs(dq[j]) <= c::start_fastest))
      return "joint " + std::to_string(j + 1) + " moves at " + std::to_string(dq[j]) + " rad/s; motions begin at rest";
  return "";
}

#ifndef CONTRACT_ON_SURFACE
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
#endif

}  // namespace law
