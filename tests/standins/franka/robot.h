// What examples/libfranka/loop.cpp calls of libfranka, declared as there (0.10 and later). The arm behind it is seven
// joints of 1 kg m^2 with viscous friction, at 1 kHz, with the faults of script.h; each command goes to stdout.
#pragma once
#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <csignal>
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <string>
#include <thread>

#include "../script.h"
#include "law.hpp"

namespace franka {

constexpr double kMaxCutoffFrequency = 1000.0;
struct Duration {};
struct Torques {
  Torques(const std::array<double, 7>& torques) noexcept : tau_J(torques) {}
  std::array<double, 7> tau_J{};
  bool motion_finished = false;
};
inline Torques MotionFinished(Torques command) noexcept {
  command.motion_finished = true;
  return command;
}
struct RobotState {
  std::array<double, 7> q{}, dq{}, tau_J_d{};
  std::array<double, 16> O_T_EE{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}, F_T_EE = O_T_EE;
};

class Robot {
 public:
  explicit Robot(const std::string&) {
    law::Model model;
    for (int j = 0; j < 7; ++j) state_.q[j] = contract::start[j] + asked("off");
    state_.dq[0] = asked("moves");
    model.place(state_.q);
    for (int i = 0; i < 3; ++i) state_.O_T_EE[12 + i] = model.ee[i] + asked("tool");
  }
  std::uint16_t serverVersion() const noexcept { return static_cast<std::uint16_t>(asked("server")); }
  void setCollisionBehavior(const std::array<double, 7>&, const std::array<double, 7>&, const std::array<double, 6>&,
                            const std::array<double, 6>&) {}
  RobotState readOnce() { return state_; }

  void control(std::function<Torques(const RobotState&, Duration)> callback, bool, double) {
    auto next = std::chrono::steady_clock::now();
    RobotState reported = state_;
    for (long cycle = 1;; ++cycle) {
      if (cycle == asked("signal_at")) std::raise(static_cast<int>(asked("signal")));
      const bool lost = asked("lost_at") > 0 && cycle >= asked("lost_at") && cycle < asked("lost_at") + asked("lost");
      if (!lost) reported = state_;  // else the arm moves on unseen
      if (cycle == asked("nan_at")) reported.q[2] = NAN;
      if (cycle == asked("jump_at")) reported.q[1] += 3.0;
      if (cycle == asked("lie_at")) reported.tau_J_d[3] += 5.0;
      const Torques command = callback(reported, {});
      const double row[] = {static_cast<double>(cycle), static_cast<double>(command.motion_finished)};
      std::fwrite(row, sizeof *row, 2, stdout);
      std::fwrite(reported.tau_J_d.data(), sizeof *row, 7, stdout);
      std::fwrite(command.tau_J.data(), sizeof *row, 7, stdout);
      std::fwrite(state_.dq.data(), sizeof *row, 7, stdout);
      if (command.motion_finished) return;
      for (int j = 0; j < 7; ++j) {
        state_.dq[j] += 1e-3 * (command.tau_J[j] - 5.0 * state_.dq[j]);
        state_.q[j] += 1e-3 * state_.dq[j];
        state_.tau_J_d[j] = command.tau_J[j];
      }
      // after a stall of this computer no burst of cycles, in which no policy could answer
      next = std::max(next + std::chrono::milliseconds(1), std::chrono::steady_clock::now());
      std::this_thread::sleep_until(next);
    }
  }

 private:
  RobotState state_;
};

}  // namespace franka
