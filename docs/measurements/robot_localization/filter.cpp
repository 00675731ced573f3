// SPDX-License-Identifier: Apache-2.0
// Runs the class Ekf of robot_localization as its node does: of each message first roll and pitch,
// then the angular velocity.
#include "robot_localization/ekf.hpp"
#include "robot_localization/filter_common.hpp"
namespace rl = robot_localization;

// stamp_ns, (n); measured and variance, (n, 5): roll, pitch, three rates; process_noise, (15);
// estimate, (n, 4): roll, pitch and their variances
extern "C" void run(
  int n, const int64_t * stamp_ns, const double * measured, const double * variance,
  const double * process_noise, double * estimate)
{
  const int members[] = {
    rl::StateMemberRoll, rl::StateMemberPitch,
    rl::StateMemberVroll, rl::StateMemberVpitch, rl::StateMemberVyaw};
  rl::Ekf filter;
  filter.setProcessNoiseCovariance(
    Eigen::Map<const Eigen::VectorXd>(process_noise, rl::STATE_SIZE).asDiagonal());
  for (int row = 0; row < n; ++row) {
    for (int column = 0; column < 5; ) {
      rl::Measurement part;
      part.time_ = rclcpp::Time(stamp_ns[row]);
      part.latest_control_ = Eigen::VectorXd::Zero(rl::TWIST_SIZE);
      part.update_vector_.assign(rl::STATE_SIZE, false);
      part.measurement_ = Eigen::VectorXd::Zero(rl::STATE_SIZE);
      part.covariance_ = Eigen::MatrixXd::Zero(rl::STATE_SIZE, rl::STATE_SIZE);
      for (const int end = column < 2 ? 2 : 5; column < end; ++column) {
        const int member = members[column];
        part.update_vector_[member] = true;
        part.measurement_(member) = measured[5 * row + column];
        part.covariance_(member, member) = variance[5 * row + column];
      }
      filter.processMeasurement(part);
    }
    for (int angle = 0; angle < 2; ++angle) {
      const int member = members[angle];
      estimate[4 * row + angle] = filter.getState()(member);
      estimate[4 * row + 2 + angle] = filter.getEstimateErrorCovariance()(member, member);
    }
  }
}
