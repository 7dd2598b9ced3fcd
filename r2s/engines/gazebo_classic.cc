// The arm in Gazebo Classic in lock-step: a world plugin that waits for a command before each step.
//
// r2s/engines/gazebo_classic.py starts the server and holds the other ends of two pipes. The values are doubles; n is
// the number of joints, from the base outwards.
//     states, written here:   q (n) rad, dq (n) rad/s, before each step
//     commands, read here:    1: set the state, 0: do not; torque (n) Nm; q (n) rad, dq (n) rad/s
// When r2s closes the pipe of commands, the server ends.
#include <unistd.h>

#include <cstdlib>
#include <iostream>
#include <string>
#include <vector>

#include <gazebo/common/Events.hh>
#include <gazebo/common/Plugin.hh>
#include <gazebo/physics/physics.hh>

namespace gazebo {

class R2sLockstep : public WorldPlugin {
 public:
  void Load(physics::WorldPtr world, sdf::ElementPtr sdf) override {
    this->states = sdf->Get<int>("states");
    this->commands = sdf->Get<int>("commands");
    const auto model = world->ModelByName(sdf->Get<std::string>("model"));
    for (auto at = sdf->GetElement("joint"); at; at = at->GetNextElement("joint")) {
      this->joints.push_back(model ? model->GetJoint(at->Get<std::string>()) : nullptr);
      if (!this->joints.back()) {
        std::cerr << "r2s: no joint " << at->Get<std::string>() << " in the world" << std::endl;
        std::_Exit(1);  // an exception would leave the server running without its plugin
      }
    }
    this->update = event::Events::ConnectWorldUpdateBegin([this](const common::UpdateInfo &) { this->Step(); });
  }

 private:
  void Step() {
    const std::size_t n = this->joints.size();
    std::vector<double> state(2 * n), command(1 + 3 * n);
    for (std::size_t i = 0; i < n; ++i) {
      state[i] = this->joints[i]->Position(0);
      state[n + i] = this->joints[i]->GetVelocity(0);
    }
    // a pipe transfers up to 4096 bytes at once, enough for 170 joints
    const ssize_t out = state.size() * sizeof(double), in = command.size() * sizeof(double);
    if (write(this->states, state.data(), out) != out || read(this->commands, command.data(), in) != in)
      std::_Exit(0);  // r2s has closed the pipes; an orderly end takes more than 10 s
    const double *tau = &command[1], *q = tau + n, *dq = q + n;
    if (command[0] != 0) {  // positions first, from the base outwards: a joint moves the links beyond it
      for (std::size_t i = 0; i < n; ++i) this->joints[i]->SetPosition(0, q[i]);
      for (std::size_t i = 0; i < n; ++i) this->joints[i]->SetVelocity(0, dq[i]);
    }
    for (std::size_t i = 0; i < n; ++i) this->joints[i]->SetForce(0, tau[i]);
  }

  std::vector<physics::JointPtr> joints;
  int states = -1, commands = -1;
  event::ConnectionPtr update;
};

GZ_REGISTER_WORLD_PLUGIN(R2sLockstep)

}  // namespace gazebo
