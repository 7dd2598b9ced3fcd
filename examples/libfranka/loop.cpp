// A policy of `r2s export` on an arm of Franka Robotics: observation, driver and safety filter in each cycle, and beside
// the cycle ONNX Runtime in a thread of its own.
//
//   g++ -std=c++17 -O2 -pthread -I BUNDLE loop.cpp -lfranka -lonnxruntime -o loop
//   python BUNDLE/r2s_runtime.py BUNDLE && ./loop 172.16.0.2 BUNDLE/policy.onnx 0.5 0.1 0.4
//
// A policy that presses or wipes takes a plan: ./loop 172.16.0.2 BUNDLE/policy.onnx BUNDLE/plan.npy
//
// The contract is compiled in (contract.hpp), so a program is of one bundle and one policy.onnx. r2s_runtime.py says
// whether the files of the bundle are what was exported. Exit status: 0 at the end of the time, 3 if the arm was brought
// to rest before, 2 if nothing moved, 1 after an error of the arm. Read docs/explanation/safety.md before the first
// motion: a hand on the stop, nobody in reach.
#include <franka/exception.h>
#include <franka/robot.h>
#include <onnxruntime_cxx_api.h>

#include <charconv>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <string_view>
#include <thread>

#include "law.hpp"
#include "mailbox.hpp"
#include "sha256.hpp"
#ifdef CONTRACT_ON_SURFACE
#include "surface.hpp"
#endif

static_assert(law::n == 7, "libfranka's arms have seven joints");
static_assert(contract::cycle_hz == 1000, "libfranka's cycle is of 1 kHz");
static_assert(std::string_view(contract::torque) == "without gravity", "libfranka's arms compensate it themselves");

constexpr double agree = 5e-3;    // m, between the end effector of the arm and that of the bundle
constexpr int first_of_fr3 = 6;   // server version; FR3s slow down before their limits, and so has the bundle's law to
using Observation = std::array<float, contract::observations>;

volatile std::sig_atomic_t signalled = 0;  // the first signal; the cycle brings the arm to rest

void on_signal(int number) {
  if (!signalled) signalled = number;
}

// The policy in a thread of its own: a cycle gives an observation, and takes the newest action.
class Policy {
 public:
  explicit Policy(const char* path) : content_(read(path)), session_(env_, content_.data(), content_.size(), one_thread()) {
    law::Command command;
    Observation seen{};
    run(seen, command);  // the first call allocates
    thread_ = std::thread([this] { work(); });
  }
  ~Policy() {
    ends_ = true;
    thread_.join();
  }

  void give(const Observation& seen) { seen_.put(seen); }
  bool newest(law::Command& command) { return made_.take(command); }

 private:
  std::string content_;
  Ort::Env env_{ORT_LOGGING_LEVEL_WARNING, "r2s"};
  Ort::Session session_;
  Ort::MemoryInfo memory_ = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
  Mailbox<Observation> seen_;
  Mailbox<law::Command> made_;
  std::atomic<bool> ends_{false};
  std::thread thread_;

  static std::string read(const char* path) {
    std::ifstream file(path, std::ios::binary);
    const std::string content{std::istreambuf_iterator<char>(file), {}};
    if (const std::string found = sha256(content); found != contract::policy_sha256)
      throw std::runtime_error(std::string(path) + " is not the policy of this program: its sha256 is " + found +
                               ", not " + contract::policy_sha256);
    return content;
  }

  static Ort::SessionOptions one_thread() {
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1);  // no waiting for other threads
    return options;
  }

  void work() {
    Observation seen{};
    law::Command command{};
    while (!ends_) {
      if (!seen_.take(seen)) {
        std::this_thread::sleep_for(std::chrono::microseconds(100));
        continue;
      }
      try {
        run(seen, command);
        made_.put(command);
      } catch (const std::exception& error) {  // without commands the driver stops the arm
        std::fprintf(stderr, "error: policy: %s\n", error.what());
        return;
      }
    }
  }

  // Write the policy's action, in SI units.
  void run(Observation& seen, law::Command& command) {
    const std::array<int64_t, 2> shape{1, contract::observations};
    const char* in[] = {"observation"};
    const char* out[] = {contract::action};
    Ort::Value tensor = Ort::Value::CreateTensor<float>(memory_, seen.data(), seen.size(), shape.data(), shape.size());
    const auto result = session_.Run(Ort::RunOptions{nullptr}, in, &tensor, 1, out, 1);
    const float* action = result.front().GetTensorData<float>();
    std::copy(action, action + contract::actions, command.begin());
  }
};

// A finite number that is the whole word: no comma, no unit, no space.
double number(const char* word) {
  double value = 0.0;
  const char* end = word + std::strlen(word);
  const auto [at, error] = std::from_chars(word, end, value);
  if (error != std::errc() || at != end || !std::isfinite(value))
    throw std::runtime_error(std::string("expected a number such as 0.5, got '") + word + "'");
  return value;
}

// Refuse an arm that the bundle was not made for, or that does not rest where motions begin.
void check(franka::Robot& robot, const franka::RobotState& now) {
  const bool slows = std::any_of(contract::slowing, contract::slowing + law::n, [](double x) { return x < INFINITY; });
  if (robot.serverVersion() >= first_of_fr3 && !slows)
    throw std::runtime_error(std::string("this arm is an FR3, the bundle is of '") + contract::robot +
                             "' and does not slow down before an FR3's limits");
  if (const std::string why = law::moves(now.dq); !why.empty()) throw std::runtime_error(why);
  law::Model model;
  model.place(now.q);
  // O_T_EE and F_T_EE are columns of a frame; the bundle's end effector may be the flange or the tool
  const auto& tool = now.F_T_EE;
  law::Vec off{}, flange_off{};
  for (int i = 0; i < 3; ++i) {
    double flange = now.O_T_EE[12 + i];
    for (int k = 0; k < 3; ++k) {
      double turned = 0.0;  // row i, column k of O_T_EE times the transposed rotation of F_T_EE
      for (int m = 0; m < 3; ++m) turned += now.O_T_EE[4 * m + i] * tool[4 * m + k];
      flange -= turned * tool[12 + k];
    }
    off[i] = model.ee[i] - now.O_T_EE[12 + i], flange_off[i] = model.ee[i] - flange;
  }
  const double nearest = std::sqrt(std::min(law::dot(off, off), law::dot(flange_off, flange_off)));
  if (!(nearest <= agree))
    throw std::runtime_error("the arm's end effector is " + std::to_string(1e3 * nearest) +
                             " mm from the bundle's: another arm or tool");
}

// What the policy shall do: a point to reach, or a plan on a surface.
#ifdef CONTRACT_ON_SURFACE
constexpr int words = 4;
constexpr const char* usage = "PLAN.npy";
constexpr double seconds = static_cast<double>(contract::plan_rows - 1) / contract::policy_hz;
struct Goal {
  law::Plan plan;
  long limited = 0;
  explicit Goal(char** argv) : plan(argv[3]) {}
  void check_start(const franka::RobotState& now) const {
    for (int j = 0; j < law::n; ++j)
      if (!(std::abs(now.q[j] - plan.start()[j]) <= contract::start_within))
        throw std::runtime_error("joint " + std::to_string(j + 1) + " is at " + std::to_string(now.q[j]) +
                                 " rad; the plan begins at " + std::to_string(plan.start()[j]));
  }
  const double* setpoint(long step) const { return plan.row(step) + contract::column_setpoint; }
  Observation observe(const law::Driver& driver, const franka::RobotState& state, long step) {
    constexpr double every = contract::cycle_hz / contract::policy_hz;
    const double share = static_cast<double>(driver.limited - limited) / every;
    limited = driver.limited;
    return law::observe(driver, state.q, state.dq, state.tau_J_d, plan.row(step), share);
  }
  law::Vec left(const law::Driver& driver, long step) const {
    using law::operator-;
    const double* x = plan.row(step);
    return law::Vec{x[0], x[1], x[2]} - driver.model.point(contract::tip);
  }
};
#else
constexpr int words = 6;
constexpr const char* usage = "X Y Z   (goal in m, in the base frame)";
constexpr double seconds = 10.0;
struct Goal {
  law::Vec point;
  explicit Goal(char** argv) : point{number(argv[3]), number(argv[4]), number(argv[5])} {
    if (const std::string why = law::refused(point); !why.empty()) throw std::runtime_error(why);
  }
  void check_start(const franka::RobotState& now) const {
    if (const std::string why = law::refused(now.q); !why.empty()) throw std::runtime_error(why);
  }
  const double* setpoint(long) const { return point.data(); }
  Observation observe(const law::Driver& driver, const franka::RobotState& state, long) const {
    return law::observe(driver, state.q, state.dq, point);
  }
  law::Vec left(const law::Driver& driver, long) const {
    using law::operator-;
    return point - driver.model.ee;
  }
};
#endif

int run(char** argv) {
  Goal goal(argv);
  Policy policy(argv[2]);
  law::Driver driver(0.5);  // the torque fades in over half a second
  franka::Robot robot(argv[1]);
  std::array<double, 7> torque;
  std::array<double, 6> force;
  std::copy_n(contract::collision_torque, 7, torque.begin());
  std::copy_n(contract::collision_force, 6, force.begin());
  robot.setCollisionBehavior(torque, torque, force, force);
  const franka::RobotState now = robot.readOnce();
  goal.check_start(now);
  check(robot, now);
  constexpr long every = contract::cycle_hz / contract::policy_hz;
  constexpr long last = static_cast<long>(seconds * contract::cycle_hz);
  long cycle = 0;
  law::Command command{};
  std::array<double, contract::setpoints + 1> setpoint{};  // of the observation that the newest action answers
  const auto callback = [&](const franka::RobotState& state, franka::Duration) -> franka::Torques {
    driver.model.place(state.q);
    if (signalled || cycle >= last) driver.stop();
    if (cycle % every == 0) {
      policy.give(goal.observe(driver, state, cycle / every));
      std::copy_n(goal.setpoint(cycle / every), contract::setpoints, setpoint.begin());
    }
    ++cycle;
    const bool asked = policy.newest(command);
    std::copy_n(setpoint.begin(), contract::setpoints, command.begin() + contract::actions);
    const law::Joints tau = driver(state.q, state.dq, state.tau_J_d, asked ? &command : nullptr);
    return driver.done() ? franka::MotionFinished(franka::Torques(tau)) : franka::Torques(tau);
  };
  // the driver has its own rate limit and low-pass, so libfranka's are off
  robot.control(callback, false, franka::kMaxCutoffFrequency);
  const law::Vec left = goal.left(driver, cycle / every);
  std::printf("at rest after %.2f s, %.1f mm from the goal\n", 1e-3 * cycle, 1e3 * std::sqrt(law::dot(left, left)));
  if (driver.why == law::Driver::requested && !signalled) return 0;
  const char* whys[] = {"", "no finite action of the policy in time", "the arm's state is not finite",
                        "a joint is too close to a limit", "the controller's torque is not finite", "a signal"};
  std::fprintf(stderr, "stopped: %s\n", whys[driver.why]);
  return 3;
}

int main(int argc, char** argv) {
  if (argc != words) {
    std::fprintf(stderr, "usage: %s ROBOT_ADDRESS POLICY.onnx %s\n", argv[0], usage);
    return 2;
  }
  struct sigaction action {};
  action.sa_handler = on_signal;
  action.sa_flags = SA_RESTART;  // libfranka's sockets go on
  for (const int number : {SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGTSTP}) sigaction(number, &action, nullptr);
  std::signal(SIGPIPE, SIG_IGN);  // a closed terminal
  try {
    return run(argv);
  } catch (const franka::Exception& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 2;
  }
}
