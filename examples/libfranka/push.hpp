// Limit of pushes, and what a stop does with a force: a third implementation of r2s/physics/push_limit.py, which
// derives it, and of r2s/physics/contact_stop.py.
#pragma once
#include "model.hpp"

namespace law {

namespace p = contract::push;

class Push {
 public:
  enum Phase { begins, presses, clear, over };
  Phase phase = begins;  // of a stop

  // Take the motion of the tip: mass matrix and Coriolis torque at dq.
  void see(const Model& m, const Joints& dq, const Square& mass, const Joints& bias) {
    const Vec normal{p::normal[0], p::normal[1], p::normal[2]}, place = m.point(p::tip);
    const Vec off = place - Vec{p::point[0], p::point[1], p::point[2]}, velocity = m.velocity(place, dq);
    const double height = dot(normal, off), aside = std::sqrt(std::max(dot(off, off) - height * height, 0.0));
    height_ = height - (p::radius + p::margin + p::slope * aside);
    speed_ = -dot(normal, velocity);
    along_ = std::sqrt(std::max(dot(velocity, velocity) - speed_ * speed_, 0.0));
    row_ = m.pull(place, -1.0 * normal);
    Vec omega{}, alpha{}, a{};
    for (int j = 0; j < n; ++j) {
      const Vec spin = dq[j] * m.axis[j], way = (j + 1 < n ? m.origin[j + 1] : place) - m.origin[j];
      alpha = alpha + cross(omega, spin);
      omega = omega + spin;
      a = a + cross(alpha, way) + cross(omega, cross(omega, way));
    }
    convective_ = -dot(normal, a);
    Square root = mass;
    lever_ = row_;
    solve(root, lever_, n);
    mobility_ = along(row_);
    dq_ = dq, mass_ = mass, bias_ = bias;
  }

  // Change a torque to the nearest within all bounds; return whether it is another. joints: the bounds of the joints
  // for a torque, and the bias of an arm that touches.
  template <class Bounded>
  bool limit(Joints& out, const Joints& last, const Bounded& joints) {
    const double most = bound(last);
    const Joints effort = out;
    Joints bias;
    for (int j = 0; j < n; ++j) bias[j] = bias_[j] + std::max(resisted_, 0.0) * row_[j];
    const bool changed = joints(out, bias);
    double before = along(out) - most;
    if (before <= 0.0) return changed;
    double low = 0.0, high = INFINITY, after = 0.0, force = (before + 0.5 * p::close) / mobility_;
    for (int trial = 0; trial < p::trials; ++trial) {
      for (int j = 0; j < n; ++j) out[j] = effort[j] - force * row_[j];
      joints(out, bias);
      const double now = along(out) - most;
      if (-p::close <= now && now <= 0.0) break;
      if (now > 0.0) {
        low = force, before = now, after *= 0.5;
      } else {
        before *= high < INFINITY ? 0.5 : 1.0;
        high = force, after = now;
      }
      if (high == INFINITY) {
        force *= 2.0;
      } else {
        const double x = before + 0.5 * p::close, y = after + 0.5 * p::close;
        force = y < 0.0 ? (low * y - high * x) / (y - x) : 0.5 * (low + high);
      }
    }
    return true;
  }

  // Write the target of a stop; return the share of the allowed speeds that it needs. held: Nm, which come on top.
  double stop(const Joints& held, long cycles, Joints& target) {
    if (cycles * c::cycle_s > p::leaves_s) phase = over;
    const double felt = resisted_ - along(held) / mobility_;
    if (phase == begins) {
      felt_ = height_ < 0.0 ? std::max(felt, 0.0) : 0.0;
      phase = p::stop == p::hold || height_ >= 0.0 ? over : presses;
    }
    if (phase == over) {
      for (int j = 0; j < n; ++j) target[j] = p::stop == p::hold ? felt_ * row_[j] : 0.0;
      return 0.0;
    }
    double share = 0.0, behind = 0.0;
    for (int j = 0; j < n; ++j) share = std::max(share, p::leave / mobility_ * std::abs(lever_[j]) / c::most[j]);
    const double part = std::min(1.0, p::most / share);
    Joints ahead, ddq;
    for (int j = 0; j < n; ++j) {
      const double asked = -p::leave / mobility_ * part * lever_[j];
      ahead[j] = c::friction[j] * std::tanh(asked / c::dry);
      behind -= lever_[j] * ahead[j] / mobility_;
      ddq[j] = p::gain * (asked - dq_[j]);
    }
    const double faster = p::gain * p::gain / mobility_ * (p::leave * part + speed_);
    pull_ = std::min(std::max(pull_ + c::cycle_s * faster, 0.0), behind);
    for (int j = 0; j < n; ++j) {
      target[j] = bias_[j] + (std::max(felt, 0.0) - pull_) * row_[j] + ahead[j];
      for (int k = 0; k < n; ++k) target[j] += mass_[j][k] * ddq[k];
    }
    if (phase == presses && speed_ < -0.2 * p::leave && felt <= p::released - p::slides * behind)
      phase = p::stop == p::retreat ? clear : over, from_ = height_;
    if (phase == clear && height_ >= from_ + p::retreat_m) phase = over;
    return std::min(share, p::most);
  }

 private:
  Joints row_{}, lever_{}, dq_{}, bias_{};
  Square mass_{};
  double height_ = 0.0, speed_ = 0.0, along_ = 0.0, convective_ = 0.0, mobility_ = 1.0;
  double resisted_ = 0.0, before_ = 0.0, felt_ = 0.0, from_ = 0.0, pull_ = 0.0;
  bool begun_ = false;

  double along(const Joints& tau) const {
    double out = 0.0;
    for (int j = 0; j < n; ++j) out += lever_[j] * tau[j];
    return out;
  }

  // How large an inward acceleration a torque may cause, after the torque `last`.
  double bound(const Joints& last) {
    if (height_ > p::near_m) {
      resisted_ = 0.0, begun_ = false;
      return INFINITY;
    }
    double hidden = 0.0;
    for (int j = 0; j < n; ++j) hidden += std::abs(lever_[j]) * c::friction[j];
    const double own = convective_ - along(bias_), mass = 1.0 / mobility_;
    if (!begun_) before_ = speed_, begun_ = true;
    const double pushed = c::cycle_s * (mass * (own + along(last)) - resisted_);
    double resisted = resisted_ + c::rate * (pushed - mass * (speed_ - before_));
    const double allowed = p::speed_near - p::slope * along_ + c::approach * std::max(height_, 0.0);
    if (speed_ > allowed || speed_ < -(phase == begins ? p::speed_near : p::overshoot * p::leave))
      resisted = std::min(resisted, 0.0);
    resisted_ = std::clamp(resisted, -p::force_max, p::force_max), before_ = speed_;
    const double brakes = c::rate * (allowed - speed_) + mobility_ * resisted_;
    return std::min(brakes, mobility_ * p::force_max - hidden) - own;
  }
};

}  // namespace law
