// Kinematics and dynamics of the arm of a bundle in plain C++17.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>

#include "contract.hpp"

namespace law {

namespace c = contract;
constexpr int n = contract::n;
using Vec = std::array<double, 3>;
using Mat = std::array<double, 9>;  // row by row
using Joints = std::array<double, n>;
using Square = std::array<Joints, n>;

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

// Masses of the links: the model of the arm's own compensation.
struct Links {
  const double* mass = c::mass;
  const double (*com)[3] = c::com;
  const double (*tensor)[6] = c::tensor;
};

// Kinematics and dynamics.
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
  Joints pull(const Vec& force) const { return pull(ee, force); }
  Joints pull(const Vec& at, const Vec& force) const {
    Joints out;
    for (int j = 0; j < n; ++j) out[j] = dot(cross(axis[j], at - origin[j]), force);
    return out;
  }

  // A point of the last link, which its frame has at `own`.
  Vec point(const double* own) const { return origin[n - 1] + frame[n - 1] * Vec{own[0], own[1], own[2]}; }

  Vec velocity(const Vec& at, const Joints& dq) const {
    Vec out{};
    for (int j = 0; j < n; ++j) out = out + dq[j] * cross(axis[j], at - origin[j]);
    return out;
  }

  // Mass matrix and the torque of Coriolis and gravity: Newton and Euler for the torque, the links' own energies for
  // the matrix.
  void equations(const Joints& dq, Square& mass, Joints& bias, const Vec& gravity = {}, const Links& of = {}) const {
    Vec omega{}, alpha{}, a = -1.0 * gravity, before{};
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
      const Vec own = frame[k] * Vec{of.com[k][0], of.com[k][1], of.com[k][2]};
      const Vec centre = origin[k] + own;
      const double* t = of.tensor[k];
      const Mat tensor = frame[k] * Mat{t[0], t[3], t[4], t[3], t[1], t[5], t[4], t[5], t[2]} * transposed(frame[k]);
      const Vec force = of.mass[k] * (a + cross(alpha, own) + cross(omega, cross(omega, own)));
      const Vec moment = tensor * alpha + cross(omega, tensor * omega);
      for (int j = 0; j <= k; ++j) {
        const Vec arm = centre - origin[j], moves = cross(axis[j], arm), turns = tensor * axis[j];
        bias[j] += dot(moves, force) + dot(axis[j], moment);
        for (int i = 0; i <= j; ++i) {
          const double m = of.mass[k] * dot(cross(axis[i], centre - origin[i]), moves) + dot(axis[i], turns);
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

}  // namespace law
