// SPDX-License-Identifier: Apache-2.0
// What the filter of robot_localization uses of rclcpp, so that it compiles without ROS.
#pragma once
#include <cstdint>
#include <iomanip>
typedef int64_t rcl_time_point_value_t;
enum rcl_clock_type_t { RCL_ROS_TIME };
namespace rclcpp
{
template<class T>
class Nanoseconds
{
public:
  explicit Nanoseconds(int64_t ns)
  : ns_(ns) {}
  int64_t nanoseconds() const {return ns_;}
  bool operator>(const T & other) const {return ns_ > other.ns_;}
  bool operator>=(const T & other) const {return ns_ >= other.ns_;}
  bool operator<(const T & other) const {return ns_ < other.ns_;}
  bool operator<=(const T & other) const {return ns_ <= other.ns_;}
  int64_t ns_;
};
class Duration : public Nanoseconds<Duration>
{
public:
  Duration(int32_t s, uint32_t ns)
  : Nanoseconds(int64_t{s} * 1000000000 + ns) {}
  explicit Duration(int64_t ns)
  : Nanoseconds(ns) {}
  static Duration from_seconds(double s) {return Duration(static_cast<int64_t>(s * 1e9));}
};
class Time : public Nanoseconds<Time>
{
public:
  explicit Time(int64_t ns = 0, rcl_clock_type_t = RCL_ROS_TIME)
  : Nanoseconds(ns) {}
  Time(int32_t s, uint32_t ns, rcl_clock_type_t)
  : Nanoseconds(int64_t{s} * 1000000000 + ns) {}
  Duration operator-(const Time & other) const {return Duration(ns_ - other.ns_);}
};
}  // namespace rclcpp
