// What examples/libfranka/loop.cpp calls of libfranka, declared as there (0.10 and later); it does nothing.
#pragma once
#include <array>
#include <cstddef>
#include <functional>
#include <string>

namespace franka {

constexpr double kMaxCutoffFrequency = 1000.0;
struct Duration {};
struct Torques {
  Torques(const std::array<double, 7>&) noexcept {}
  bool motion_finished = false;
};
inline Torques MotionFinished(Torques command) noexcept { return command; }
struct RobotState {
  std::array<double, 7> q{}, dq{}, tau_J_d{};
};
struct Robot {
  explicit Robot(const std::string&) {}
  void setCollisionBehavior(const std::array<double, 7>&, const std::array<double, 7>&, const std::array<double, 6>&,
                            const std::array<double, 6>&) {}
  RobotState readOnce() { return {}; }
  void control(std::function<Torques(const RobotState&, Duration)>, bool, double) {}
};

}  // namespace franka
