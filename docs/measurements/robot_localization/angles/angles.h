// SPDX-License-Identifier: Apache-2.0
#pragma once
#include <cmath>
namespace angles
{
inline double normalize_angle(double rad) {return std::remainder(rad, 2 * M_PI);}
}  // namespace angles
