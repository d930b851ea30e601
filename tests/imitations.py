"""Headers that imitate what exported packages use of ros2_control (Jazzy) and libfranka, and what drives them."""

ROS = {
    "controller_interface/chainable_controller_interface.hpp": r"""
#pragma once
#include <map>
#include <memory>
#include <string>
#include <vector>
namespace rclcpp { struct Time {}; struct Duration { double s; double seconds() const { return s; } }; }
namespace rclcpp_lifecycle { struct State {}; }
namespace hardware_interface {
struct CommandInterface {
  CommandInterface(const std::string &, const std::string & n, double * v) : name(n), value(v) {}
  std::string name; double * value;
};
struct LoanedCommandInterface { double * at; [[nodiscard]] bool set_value(double x) { *at = x; return true; } };
struct LoanedStateInterface { double * at; double get_value() const { return *at; } };
}
namespace controller_interface {
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };
struct InterfaceConfiguration { interface_configuration_type type; std::vector<std::string> names; };
struct Node { const char * get_name() const { return "law"; } };
class ChainableControllerInterface {
public:
  virtual ~ChainableControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
  virtual return_type update_and_write_commands(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  std::shared_ptr<Node> get_node() const { return std::make_shared<Node>(); }
  unsigned int get_update_rate() const { return 1000; }
  template <typename T> T auto_declare(const std::string &, const T & given) { return given; }
protected:
  virtual std::vector<hardware_interface::CommandInterface> on_export_reference_interfaces() = 0;
  virtual return_type update_reference_from_subscribers(const rclcpp::Time &, const rclcpp::Duration &) = 0;
  std::vector<double> reference_interfaces_;
  std::vector<hardware_interface::LoanedCommandInterface> command_interfaces_;
  std::vector<hardware_interface::LoanedStateInterface> state_interfaces_;
};
}
""",
    "hardware_interface/types/hardware_interface_type_values.hpp": r"""
#pragma once
namespace hardware_interface {
constexpr char HW_IF_POSITION[] = "position", HW_IF_VELOCITY[] = "velocity", HW_IF_ACCELERATION[] = "acceleration";
constexpr char HW_IF_EFFORT[] = "effort";
}
""",
    "pluginlib/class_list_macros.hpp": "#define PLUGINLIB_EXPORT_CLASS(one, base) static_assert(sizeof(one) > 0);\n",
    "rclcpp_lifecycle/state.hpp": "",
}

ROS_DRIVER = r"""
#include "LAW_controller.cpp"
#include <iostream>
struct Driven : LAW::Controller {
  double state[2 * LAW::n], command[LAW::n];
  bool run() {
    on_init();
    auto references = on_export_reference_interfaces();
    const auto inputs = state_interface_configuration().names;
    const auto outputs = command_interface_configuration().names;
    for (int i = 0; i < 2 * LAW::n; i++) { state[i] = 0.1 * i; state_interfaces_.push_back({&state[i]}); }
    for (int i = 0; i < LAW::n; i++) command_interfaces_.push_back({&command[i]});
    std::cout << inputs.front() << " " << inputs.back() << " " << outputs.back() << " ";
    std::cout << references.back().name << "\n";
    on_activate({});
    *references[0].value = 0.3;
    LAW_state own; LAW_real tau[LAW::n], zero[LAW::n] = {}, q[LAW::n], v[LAW::n], r[LAW::n];
    for (int i = 0; i < LAW::n; i++) { q[i] = r[i] = 0.1 * i; v[i] = 0.1 * (LAW::n + i); }
    r[0] = 0.3;
    LAW_start(&own, zero);
    LAW_torque(&own, q, zero, q, zero, zero, 0.001, tau);
    LAW_start(&own, tau);
    LAW_step(&own, q, v, r, zero, zero, 0.001, tau);
    if (update_and_write_commands({}, {0.005}) != controller_interface::return_type::OK) return false;
    for (int i = 0; i < LAW::n; i++) if (command[i] != tau[i]) return false;
    state[0] = std::nan("");
    for (int k = 0; k < 19; k++)
      if (update_and_write_commands({}, {0.001}) != controller_interface::return_type::OK) return false;
    for (int i = 0; i < LAW::n; i++) if (command[i] != tau[i]) return false;
    return update_and_write_commands({}, {0.001}) == controller_interface::return_type::ERROR;
  }
};
int main() { return !Driven().run(); }
"""

FRANKA = {
    "franka/exception.h": "#pragma once\n#include <stdexcept>\n",
    "franka/model.h": r"""
#pragma once
#include <array>
namespace franka {
struct RobotState;
struct Model { std::array<double, 7> gravity(const RobotState &) const { return {1, 2, 3, 4, 5, 6, 7}; } };
}
""",
    "franka/robot.h": r"""
#pragma once
#include <array>
#include <cmath>
#include <functional>
#include <iostream>
#include <stdexcept>
#include <string>
#include <franka/model.h>
namespace franka {
struct Duration { double s; double toSec() const { return s; } };
struct Torques {
  Torques(const std::array<double, 7> & t) : tau(t) {}
  std::array<double, 7> tau;
  bool motion_finished = false;
};
inline Torques MotionFinished(Torques t) { t.motion_finished = true; return t; }
struct RobotState { std::array<double, 7> q, dq, q_d, tau_J_d; };
struct Robot {
  explicit Robot(const std::string &) {}
  Model loadModel() { return {}; }
  void control(std::function<Torques(const RobotState &, Duration)> law) {
    const std::array<double, 7> q{0, -0.8, 0, -2.3, 0, 1.6, 0.8}, held{0.5, -3, 1, 2, -0.4, 0.3, -0.2};
    RobotState state{q, {}, q, held};
    int steps = 0;
    for (bool done = false; !done; steps++) {
      const bool late = steps % 1000 == 500;  // two packets were lost, and meanwhile the arm was hit
      state.dq.fill(late ? 0.5 : 0.0);
      const Torques sent = law(state, {steps == 0 ? 0.0 : late ? 0.003 : 0.001});
      for (int i = 0; i < 7; i++)
        if (!(std::abs(sent.tau[i] - state.tau_J_d[i]) <= 1.0))  // libfranka: 1000 N m/s
          throw std::runtime_error("torque discontinuity at step " + std::to_string(steps));
      state.tau_J_d = sent.tau;
      done = sent.motion_finished;
    }
    std::cout << steps << " steps, " << state.tau_J_d[0] << "\n";
  }
};
}
""",
}
