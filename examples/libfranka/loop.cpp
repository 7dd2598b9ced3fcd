// A policy of `r2s export` on an arm of Franka Robotics: observation, ONNX Runtime, driver and safety filter, each cycle.
//
//   g++ -std=c++17 -O2 -I BUNDLE loop.cpp -lfranka -lonnxruntime -o loop
//   python BUNDLE/r2s_runtime.py BUNDLE && ./loop 172.16.0.2 BUNDLE/policy.onnx 0.5 0.1 0.4
//
// The contract is compiled in (contract.hpp), so a program is of one bundle. r2s_runtime.py says whether the files of
// the bundle are what was exported. Read docs/explanation/safety.md before the first motion: a hand on the stop, nobody in reach.
#include <franka/exception.h>
#include <franka/robot.h>
#include <onnxruntime_cxx_api.h>

#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <string>
#include <string_view>

#include "law.hpp"

static_assert(law::n == 7, "libfranka's arms have seven joints");
static_assert(contract::cycle_hz == 1000, "libfranka's cycle is of 1 kHz");
static_assert(std::string_view(contract::torque) == "without gravity", "libfranka's arms compensate it themselves");

constexpr double start_within = 0.15;  // rad, of where episodes of the training began
constexpr double seconds = 10.0;

class Policy {
 public:
  explicit Policy(const char* path) : session_(env_, path, one_thread()) {
    Ort::AllocatorWithDefaultOptions memory;
    expect(memory, "policy_hz", std::to_string(contract::policy_hz));
    std::string joints;
    for (const char* name : contract::joints) joints += joints.empty() ? name : std::string(" ") + name;
    expect(memory, "joints", joints);
    law::Command command;
    std::array<float, contract::observations> seen{};
    (*this)(seen, command);  // the first call allocates
  }

  // Write the policy's action, in SI units.
  void operator()(std::array<float, contract::observations>& seen, law::Command& command) {
    const std::array<int64_t, 2> shape{1, contract::observations};
    const char* in[] = {"observation"};
    const char* out[] = {contract::action};
    Ort::Value tensor = Ort::Value::CreateTensor<float>(memory_, seen.data(), seen.size(), shape.data(), shape.size());
    const auto result = session_.Run(Ort::RunOptions{nullptr}, in, &tensor, 1, out, 1);
    const float* action = result.front().GetTensorData<float>();
    std::copy(action, action + contract::actions, command.begin());
  }

 private:
  Ort::Env env_{ORT_LOGGING_LEVEL_WARNING, "r2s"};
  Ort::Session session_;
  Ort::MemoryInfo memory_ = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);

  static Ort::SessionOptions one_thread() {
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1);  // no waiting for other threads
    return options;
  }

  void expect(Ort::AllocatorWithDefaultOptions& memory, const char* key, const std::string& wanted) {
    const auto found = session_.GetModelMetadata().LookupCustomMetadataMapAllocated(key, memory);
    if (!found || wanted != found.get())
      throw std::runtime_error(std::string("policy.onnx is of another bundle: ") + key + " is not " + wanted);
  }
};

int main(int argc, char** argv) {
  using law::operator-;
  if (argc != 6) {
    std::fprintf(stderr, "usage: %s ROBOT_ADDRESS POLICY.onnx X Y Z   (goal in m, in the base frame)\n", argv[0]);
    return 2;
  }
  const law::Vec goal{std::atof(argv[3]), std::atof(argv[4]), std::atof(argv[5])};
  try {
    Policy policy(argv[2]);
    law::Driver driver(0.5);  // the torque fades in over half a second
    franka::Robot robot(argv[1]);
    robot.setCollisionBehavior({{20, 20, 20, 20, 10, 10, 10}}, {{20, 20, 20, 20, 10, 10, 10}},
                               {{20, 20, 20, 20, 20, 20}}, {{20, 20, 20, 20, 20, 20}});
    const franka::RobotState now = robot.readOnce();
    for (int j = 0; j < law::n; ++j)
      if (!(std::abs(now.q[j] - contract::start[j]) <= start_within))
        throw std::runtime_error("joint " + std::to_string(j + 1) + " is at " + std::to_string(now.q[j]) +
                                 " rad; move it to " + std::to_string(contract::start[j]) + " first");
    constexpr long every = contract::cycle_hz / contract::policy_hz;
    long cycle = 0;
    law::Command command{};
    const auto callback = [&](const franka::RobotState& state, franka::Duration) -> franka::Torques {
      driver.model.place(state.q);
      // without further commands the driver brings the arm to rest
      const bool asked = cycle % every == 0 && cycle < seconds * contract::cycle_hz;
      if (asked) {
        auto seen = law::observe(driver, state.q, state.dq, goal);
        policy(seen, command);
      }
      ++cycle;
      const law::Joints tau = driver(state.q, state.dq, state.tau_J_d, asked ? &command : nullptr);
      return driver.done() ? franka::MotionFinished(franka::Torques(tau)) : franka::Torques(tau);
    };
    // the driver has its own rate limit and low-pass, so libfranka's are off
    robot.control(callback, false, franka::kMaxCutoffFrequency);
    const law::Vec left = goal - driver.model.ee;
    std::printf("at rest after %.2f s, %.1f mm from the goal\n", 1e-3 * cycle, 1e3 * std::sqrt(law::dot(left, left)));
  } catch (const franka::Exception& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "error: %s\n", error.what());
    return 2;
  }
}
