// SPDX-License-Identifier: Apache-2.0
// Copyright the contributors to mjx_climb.

/// @file
/// Load transfer: what a foot bears is handed over to the others before it lifts off, and back after it has landed.
///
/// Reference implementation of the law of mjx_climb/control/load_transfer.py, and tested against it. C++17, no
/// dependencies, no heap, no exceptions; one step takes a few thousand operations.
///
///     #include "load_transfer.hpp"
///     #include "load_transfer_gains.hpp"  // written by mjx-climb export
///
///     mjx_climb::LoadTransferState<4> state;  // no offsets: begin so, and again whenever the law is switched on
///     // once in every load_transfer_gains.period seconds:
///     mjx_climb::LoadTransferInput<4> input;
///     input.base_position = ...;              // all of it: see the struct
///     const auto feet = mjx_climb::step(mjx_climb::load_transfer_gains, state, input);
///     // inverse kinematics: the base at its reference, each foot at feet[limb]
///
/// Units are SI. The z axis of the base reference is along the ground's normal. A quaternion is of unit length. Forces
/// alone may be no numbers: those of a dead sensor. A NaN elsewhere would stay in the state. Not for -ffast-math.

#pragma once

#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

namespace mjx_climb {

struct Vector3 {
  double x = 0.0, y = 0.0, z = 0.0;
};

/// Rotates from one frame to another, here from the base to the world.
struct Quaternion {
  double w = 1.0, x = 0.0, y = 0.0, z = 0.0;
};

/// A vector for each foot.
template <std::size_t Limbs>
using Feet = std::array<Vector3, Limbs>;

/// What was tuned. `mjx-climb export` writes one as load_transfer_gains.hpp.
struct LoadTransferGains {
  double period = 0.0;              ///< s, from one step to the next
  double normal_damping = 0.0;      ///< N s/m, along the ground's normal
  double tangential_damping = 0.0;  ///< N s/m, along the ground
  double leak = 0.0;                ///< 1/s, at which offsets of feet relative to each other fade
  double leveling = 0.0;            ///< 1/s, at which offsets that move all feet as one body fade
  double unloading = 0.0;           ///< s, in which a foot hands over its load before it lifts off
  double loading = 0.0;             ///< s, in which a foot takes over load after it has touched down
  double landing = 0.0;             ///< share of the base's error that a swinging foot makes up for
  double pull_limit = 0.0;          ///< N, the largest pull on the ground that is asked of a foot (a soft limit)
  double max_offset = 0.0;          ///< m, largest distance of a foot from its reference
  double max_rate = 0.0;            ///< m/s, largest speed of a standing foot
  double torque_limit = 0.0;        ///< N m: a limb of a servo that has it is not moved further out; infinite: never
  double safe_kp = 0.0;             ///< N m/rad, of all joints at least, once a force sensor is lost
};

/// What is measured, and what the gait asks for, at one instant; world axes.
template <std::size_t Limbs>
struct LoadTransferInput {
  Vector3 base_position;                    ///< m, of the base's centre of mass, as estimated
  Quaternion base_orientation;              ///< base to world, as estimated
  Feet<Limbs> foot_force;                   ///< N, of the ground on the foot; exactly 0 or no number: no reading
  std::array<bool, Limbs> support{};        ///< whether the gripper is shut and holds
  std::array<double, Limbs> peak_torque{};  ///< N m, largest magnitude among the limb's servos; 0 where not known
  Vector3 base_position_reference;          ///< m, of the base's centre of mass
  Quaternion base_orientation_reference;    ///< base to world
  Feet<Limbs> foot_position_reference;      ///< m: where it grips, or its place in the swing
  std::array<double, Limbs> until_lift_off{};   ///< s, until the gripper opens next; 0 in a swing
  std::array<double, Limbs> since_touchdown{};  ///< s, since the gripper shut last; 0 in a swing
};

/// How far the feet are from where the gait wants them.
template <std::size_t Limbs>
struct LoadTransferState {
  Feet<Limbs> offset{};  ///< m, axes of the base reference
  Feet<Limbs> heard{};   ///< N, last reading of a foot's sensor since it stands
  /// s, from -0.1, as a sensor reads something; 0: it has not read anything yet; beyond it is not believed, from 0.1 on
  /// it is lost
  std::array<double, Limbs> doubt{};
  double kp_rise = 0.0;  ///< how far kp has risen to what is safe, from 0 to 1
};

namespace detail {

using Vector6 = std::array<double, 6>;  ///< a wrench (force, moment) or a twist (translation, rotation vector)
using Matrix6 = std::array<Vector6, 6>;

constexpr double kRelease = 0.05;       // s, in which an offset fades once its gripper has opened
constexpr double kSilence = 0.1;         // s without a reading, after which a sensor is not believed
constexpr double kStiffening = 0.5;      // s, in which kp rises once a sensor is lost, and falls once none is
constexpr double kNothing = 1e-6;        // N, finer than any sensor tells
constexpr double kLoaded = 1.0;          // N in all, with which a robot stands firmly
constexpr double kLeast = 0.02;         // weight of a foot that stands: three of them can always take the wrench
constexpr double kRegularization = 8.0; // in units of rounding: feet on a line cannot take any wrench
constexpr double kSoftness = 0.1;       // of a limit on pulls, in units of a weight
constexpr int kSweeps = 12;             // of Gauss-Seidel through the limbs

constexpr Vector3 operator+(const Vector3& a, const Vector3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
constexpr Vector3 operator-(const Vector3& a, const Vector3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
constexpr Vector3 operator*(double s, const Vector3& v) { return {s * v.x, s * v.y, s * v.z}; }
constexpr double dot(const Vector3& a, const Vector3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
constexpr Vector3 cross(const Vector3& a, const Vector3& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

/// Return a vector, shortened to the largest length.
inline Vector3 bounded(const Vector3& v, double largest) {
  const double length = std::sqrt(dot(v, v));
  return length > largest ? (largest / length) * v : v;
}

/// The columns of a rotation matrix: the axes of a frame, seen from another.
struct Rotation {
  Vector3 x, y, z;

  explicit constexpr Rotation(const Quaternion& q)
      : x{1 - 2 * (q.y * q.y + q.z * q.z), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y)},
        y{2 * (q.x * q.y - q.w * q.z), 1 - 2 * (q.x * q.x + q.z * q.z), 2 * (q.y * q.z + q.w * q.x)},
        z{2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x * q.x + q.y * q.y)} {}

  constexpr Vector3 to_world(const Vector3& v) const { return v.x * x + v.y * y + v.z * z; }
  constexpr Vector3 from_world(const Vector3& v) const { return {dot(x, v), dot(y, v), dot(z, v)}; }
};

/// Return the small rotation from `reference` to `measured` as a vector, in the axes of `reference`.
constexpr Vector3 turn_between(const Quaternion& reference, const Quaternion& measured) {
  const Vector3 a{-reference.x, -reference.y, -reference.z}, b{measured.x, measured.y, measured.z};
  const double real = reference.w * measured.w - dot(a, b);
  return (2 * real) * (reference.w * b + measured.w * a + cross(a, b));
}

/// A symmetric positive definite matrix as L D L^T.
class Factorized {
 public:
  explicit constexpr Factorized(const Matrix6& matrix) {
    for (std::size_t row = 0; row < 6; ++row) {
      for (std::size_t column = row; column < 6; ++column) {
        double value = matrix[row][column];
        for (std::size_t k = 0; k < row; ++k) value -= lower_[column][k] * scaled_[k][row];
        if (column == row) {
          inverse_[row] = 1 / value;
        } else {
          scaled_[row][column] = value;
          lower_[column][row] = value * inverse_[row];
        }
      }
    }
  }

  constexpr Vector6 solve(Vector6 v) const {
    for (std::size_t row = 0; row < 6; ++row) {
      for (std::size_t k = 0; k < row; ++k) v[row] -= lower_[row][k] * v[k];
    }
    for (std::size_t row = 6; row-- > 0;) {
      v[row] *= inverse_[row];
      for (std::size_t k = row + 1; k < 6; ++k) v[row] -= lower_[k][row] * v[k];
    }
    return v;
  }

 private:
  Matrix6 lower_{}, scaled_{};  // L, and D L^T
  Vector6 inverse_{};           // of D
};

/// Return the wrench that a force makes about the point where its lever begins.
constexpr Vector6 wrench_of(const Vector3& lever, const Vector3& force) {
  const Vector3 moment = cross(lever, force);
  return {force.x, force.y, force.z, moment.x, moment.y, moment.z};
}

constexpr double dot(const Vector6& a, const Vector6& b) {
  double sum = 0.0;
  for (std::size_t k = 0; k < 6; ++k) sum += a[k] * b[k];
  return sum;
}

/// Return the motion of a foot under a twist.
constexpr Vector3 moved_rigidly(const Vector3& lever, const Vector6& twist) {
  return Vector3{twist[0], twist[1], twist[2]} + cross(Vector3{twist[3], twist[4], twist[5]}, lever);
}

template <std::size_t Limbs>
constexpr Vector6 net_wrench(const Feet<Limbs>& lever, const Feet<Limbs>& force) {
  Vector6 sum{};
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    const Vector6 one = wrench_of(lever[limb], force[limb]);
    for (std::size_t k = 0; k < 6; ++k) sum[k] += one[k];
  }
  return sum;
}

/// Return `sum weight G G^T`, where `G = [1; lever x]` takes a foot's force to its wrench.
template <std::size_t Limbs>
constexpr Matrix6 weighted_grasp(const Feet<Limbs>& lever, const std::array<double, Limbs>& weight) {
  Matrix6 sum{};
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    const double w = weight[limb];
    const Vector3 r = lever[limb];
    // weight G: the wrenches of unit forces along the axes, as rows of its transpose
    const Vector6 columns[3] = {wrench_of(r, {1, 0, 0}), wrench_of(r, {0, 1, 0}), wrench_of(r, {0, 0, 1})};
    for (const Vector6& column : columns) {
      for (std::size_t i = 0; i < 6; ++i) {
        for (std::size_t j = 0; j < 6; ++j) sum[i][j] += w * column[i] * column[j];
      }
    }
  }
  for (std::size_t k = 0; k < 6; ++k) sum[k][k] += kRegularization * std::numeric_limits<double>::epsilon();
  return sum;
}

/// Return the rigid motion that is nearest to displacements, by least squares with weights.
template <std::size_t Limbs>
constexpr Feet<Limbs> rigid_part(const Feet<Limbs>& lever, const Feet<Limbs>& displacement,
                                 const std::array<double, Limbs>& weight) {
  Feet<Limbs> weighted{}, rigid{};
  for (std::size_t limb = 0; limb < Limbs; ++limb) weighted[limb] = weight[limb] * displacement[limb];
  const Vector6 twist = Factorized(weighted_grasp(lever, weight)).solve(net_wrench(lever, weighted));
  for (std::size_t limb = 0; limb < Limbs; ++limb) rigid[limb] = moved_rigidly(lever[limb], twist);
  return rigid;
}

/// Return the foot forces that make up a wrench, N: those that minimise `sum |F|^2 / weight`, where a foot's pull on the
/// ground, `-F.z`, is softly kept below `pull_limit`. A foot of weight 0 bears nothing.
///
/// A quadratic program. Its dual in the limits on pulls is solved by projected Gauss-Seidel, which keeps the wrench
/// whatever it has reached.
template <std::size_t Limbs>
constexpr Feet<Limbs> distributed(const Vector6& wrench, const Feet<Limbs>& lever,
                                  const std::array<double, Limbs>& weight, double pull_limit) {
  const Factorized grasp(weighted_grasp(lever, weight));
  const Vector3 normal{0, 0, 1};
  std::array<Vector6, Limbs> push{}, response{};  // wrench of a limb's weighted normal force; the dual that answers it
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    push[limb] = wrench_of(lever[limb], weight[limb] * normal);
    response[limb] = grasp.solve(push[limb]);
  }
  Vector6 dual = grasp.solve(wrench);

  std::array<double, Limbs> multiplier{};
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    for (std::size_t limb = 0; limb < Limbs; ++limb) {
      // the normal force as the multipliers are, and how it changes with its own
      double now = dot(push[limb], dual), own = 0.0;
      for (std::size_t other = 0; other < Limbs; ++other) {
        const double change = (limb == other ? weight[limb] : 0.0) - dot(push[limb], response[other]);
        now += change * multiplier[other];
        if (limb == other) own = change;
      }
      const double missing = -pull_limit - now - kSoftness * multiplier[limb];
      const double value = multiplier[limb] + missing / (own + kSoftness);
      multiplier[limb] = value > 0.0 ? value : 0.0;
    }
  }

  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    for (std::size_t k = 0; k < 6; ++k) dual[k] -= multiplier[limb] * response[limb][k];
  }
  Feet<Limbs> force{};
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    force[limb] = weight[limb] * (moved_rigidly(lever[limb], dual) + multiplier[limb] * normal);
  }
  return force;
}

constexpr double ramp(double time, double whole) {
  const double part = time / whole;
  return part < 0.0 ? 0.0 : part > 1.0 ? 1.0 : part;
}

/// Return how much of the wrench a foot that stands is to bear, relative to the others.
constexpr double weight_of(const LoadTransferGains& gains, double until_lift_off, double since_touchdown) {
  const double share = ramp(until_lift_off, gains.unloading) * ramp(since_touchdown, gains.loading);
  return share > kLeast ? share : kLeast;
}

inline double size_of(const Vector3& v) { return std::abs(v.x) + std::abs(v.y) + std::abs(v.z); }

/// Take in what the sensors read, and return whether their forces are to be believed. One that reads exactly 0, or no
/// number, is believed to read what it last did since its foot stands. After 0.1 s of it on a foot that stands, while
/// feet bear something, it is dead until it reads something; so it is at the start, until it first does.
template <std::size_t Limbs>
bool listen(LoadTransferState<Limbs>& state, const LoadTransferInput<Limbs>& input, double period) {
  std::array<bool, Limbs> reads{};
  double loads = 0.0;
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    const double size = size_of(input.foot_force[limb]);
    reads[limb] = size > kNothing && std::isfinite(size);
    if (reads[limb]) {
      state.heard[limb] = input.foot_force[limb];
    } else if (!input.support[limb]) {
      state.heard[limb] = Vector3{};
    }
    loads += size_of(state.heard[limb]);
  }
  const bool loaded = loads > kLoaded;
  bool known = true, lost = false;
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    double& doubt = state.doubt[limb];
    if (reads[limb]) {
      doubt = -kSilence;
    } else if (input.support[limb] && (loaded || doubt > 0.0)) {
      doubt = std::fmin(doubt + period, 2.0 * kSilence);
    }
    const bool believed = doubt < 0.0 || (!(doubt > 0.0) && !loaded);
    lost = lost || doubt >= kSilence;
    known = known && (believed || !input.support[limb]);
  }
  const double change = (lost ? period : -period) / kStiffening;
  state.kp_rise = std::fmin(std::fmax(state.kp_rise + change, 0.0), 1.0);
  return known && !lost;
}

}  // namespace detail

/// Return whether the law does without the force sensor of a limb: tell whoever runs the robot.
template <std::size_t Limbs>
bool sensor_lost(const LoadTransferState<Limbs>& state, std::size_t limb) {
  return state.doubt[limb] >= detail::kSilence;
}

/// Return what kp of all joints should be, N m/rad, where it is `kp` as long as no sensor is lost. It rises and falls
/// slowly.
template <std::size_t Limbs>
double safe_kp(const LoadTransferGains& gains, const LoadTransferState<Limbs>& state, double kp) {
  return kp + state.kp_rise * std::fmax(gains.safe_kp - kp, 0.0);
}

/// Advance the state by one period and return where the inverse kinematics should put the feet, (limb) m, world axes.
template <std::size_t Limbs>
Feet<Limbs> step(const LoadTransferGains& gains, LoadTransferState<Limbs>& state,
                 const LoadTransferInput<Limbs>& input) {
  using namespace detail;
  const Rotation axes(input.base_orientation_reference);
  const bool known = listen(state, input, gains.period);
  Feet<Limbs> force{}, lever{};
  std::array<double, Limbs> standing{}, weight{};
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    lever[limb] = axes.from_world(input.foot_position_reference[limb] - input.base_position);
    if (!input.support[limb]) continue;
    standing[limb] = 1.0;
    weight[limb] = weight_of(gains, input.until_lift_off[limb], input.since_touchdown[limb]);
    force[limb] = axes.from_world(state.heard[limb]);
  }
  const Feet<Limbs> wanted = distributed(net_wrench(lever, force), lever, weight, gains.pull_limit);
  // what of the offsets only turns and shifts the base has its own way back
  const Feet<Limbs> rigid = rigid_part(lever, state.offset, standing);
  const Vector3 shift = axes.from_world(input.base_position - input.base_position_reference);
  const Vector3 turn = turn_between(input.base_orientation_reference, input.base_orientation);
  const Vector6 error{shift.x, shift.y, shift.z, turn.x, turn.y, turn.z};

  Feet<Limbs> target{};
  for (std::size_t limb = 0; limb < Limbs; ++limb) {
    Vector3& offset = state.offset[limb];
    if (input.support[limb]) {
      // without one of the sensors all feet only go back
      const Vector3 excess = known ? force[limb] - wanted[limb] : Vector3{};
      const Vector3 yielding{excess.x / gains.tangential_damping, excess.y / gains.tangential_damping,
                             excess.z / gains.normal_damping};
      const Vector3 back = -gains.leak * (offset - rigid[limb]) - gains.leveling * rigid[limb];
      const Vector3 rate = bounded(yielding + back, gains.max_rate);
      // where servos saturate, more offset makes no more force
      const bool outward = input.peak_torque[limb] >= gains.torque_limit && dot(rate, offset) > 0.0;
      offset = bounded(offset + (outward ? 0.0 : gains.period) * rate, gains.max_offset);
    } else {  // where a swinging foot finds the ground
      const Vector3 lands = -gains.landing * moved_rigidly(lever[limb], error);
      offset = lands + std::exp(-gains.period / kRelease) * (offset - lands);
    }
    target[limb] = input.foot_position_reference[limb] + axes.to_world(offset);
  }
  return target;
}

}  // namespace mjx_climb
