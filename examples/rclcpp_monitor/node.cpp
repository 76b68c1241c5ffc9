// A monitor without Python: hears a response and a command, publishes the margin of each sample.
// Two things are the robot's: the message types with their fields, here below, and table.c. Where
// samples stop coming it says "unknown".
#include <chrono>
#include <cmath>
#include <memory>
#include <optional>

#include <geometry_msgs/msg/twist_stamped.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>
#include <std_msgs/msg/bool.hpp>

#include "nlsid_monitor.h"

using Response = nav_msgs::msg::Odometry;
using Command = geometry_msgs::msg::TwistStamped;

static double response_of(const Response& message) { return message.twist.twist.linear.x; }
static double command_of(const Command& message) { return message.twist.linear.x; }

class Monitor : public rclcpp::Node {
 public:
  Monitor() : Node("c_monitor") {
    hold_ = declare_parameter("hold", 0.1);  // s: the oldest command that is one, as in the model
    const auto stream = rclcpp::QoS(rclcpp::KeepLast(100));
    margins_ = create_publisher<sensor_msgs::msg::JointState>("~/margin", stream);
    inside_ = create_publisher<std_msgs::msg::Bool>("~/inside", rclcpp::QoS(1).transient_local());
    nlsid_start(&monitor_, &nlsid_table);
    commands_ = create_subscription<Command>(
        "command", stream, [this](Command::ConstSharedPtr message) { hear_command(*message); });
    responses_ = create_subscription<Response>(
        "response", stream, [this](Response::ConstSharedPtr message) { hear_response(*message); });
    silence_ = create_timer(std::chrono::duration<double>(std::fmax(0.1, 4.0 * nlsid_table.period)),
                            [this] { say(NLSID_UNKNOWN); });
  }

 private:
  struct Sample {
    rclcpp::Time stamp;
    double y;
  };

  // A sample is judged once a command at or after it says which one was in force before.
  void hear_command(const Command& message) {
    const rclcpp::Time stamp(message.header.stamp);
    if (waiting_ && stamp > waiting_->stamp) judge();
    newest_ = command_of(message);
    commanded_ = stamp;
    if (waiting_ && stamp == waiting_->stamp) judge();
  }

  void hear_response(const Response& message) {
    if (waiting_) judge();  // its command did not come in a period: the one before holds
    waiting_ = Sample{rclcpp::Time(message.header.stamp), response_of(message)};
    if (commanded_ && *commanded_ >= waiting_->stamp) judge();
    silence_->reset();
  }

  void judge() {
    const Sample sample = *waiting_;
    waiting_.reset();
    double u = std::nan("");
    if (commanded_) {
      const double age = (sample.stamp - *commanded_).seconds();
      if (age >= 0.0 && age <= hold_) u = newest_;
    }
    if (!first_) first_ = sample.stamp;
    const auto now = nlsid_update(&monitor_, (sample.stamp - *first_).seconds(), sample.y, u);
    sensor_msgs::msg::JointState said;
    said.header.stamp = sample.stamp;
    said.name = {"margin", "assumption", "nominal", "measured"};
    said.position = {now.margin, now.assumption, now.nominal, sample.y};
    margins_->publish(said);
    say(now.status);
  }

  void say(nlsid_status status) {
    if (said_ == status) return;
    said_ = status;
    std_msgs::msg::Bool flag;
    flag.data = status == NLSID_INSIDE;
    inside_->publish(flag);
    const char* words[] = {"unknown", "inside", "assumption violated", "outside"};
    RCLCPP_INFO(get_logger(), "%s", words[status]);
  }

  nlsid_monitor monitor_;
  double hold_, newest_ = 0.0;
  std::optional<rclcpp::Time> first_, commanded_;
  std::optional<Sample> waiting_;
  std::optional<nlsid_status> said_;
  rclcpp::Publisher<sensor_msgs::msg::JointState>::SharedPtr margins_;
  rclcpp::Publisher<std_msgs::msg::Bool>::SharedPtr inside_;
  rclcpp::Subscription<Command>::SharedPtr commands_;
  rclcpp::Subscription<Response>::SharedPtr responses_;
  rclcpp::TimerBase::SharedPtr silence_;
};

int main(int argc, char** argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Monitor>());
  rclcpp::shutdown();
}
