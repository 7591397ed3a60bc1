// Steps the law through the inputs on standard input and writes what it returns, doubles of this machine both.
#include <cstdio>

#include "load_transfer.hpp"
#include "load_transfer_gains.hpp"

static bool take(double& value) { return std::fread(&value, sizeof value, 1, stdin) == 1; }
static bool take(mjx_climb::Vector3& v) { return take(v.x) && take(v.y) && take(v.z); }
static bool take(mjx_climb::Quaternion& q) { return take(q.w) && take(q.x) && take(q.y) && take(q.z); }
static bool take(bool& flag) {
  double value = 0.0;
  const bool got = take(value);
  flag = value != 0.0;
  return got;
}
template <class Each>
static bool take(Each& each) {
  bool got = true;
  for (auto& one : each) got = got && take(one);
  return got;
}

int main() {
  mjx_climb::LoadTransferState<LIMBS> state;
  mjx_climb::LoadTransferInput<LIMBS> in;
  while (take(in.base_position) && take(in.base_orientation) && take(in.foot_force) && take(in.support) &&
         take(in.peak_torque) && take(in.base_position_reference) && take(in.base_orientation_reference) &&
         take(in.foot_position_reference) && take(in.until_lift_off) && take(in.since_touchdown)) {
    const auto feet = mjx_climb::step(mjx_climb::load_transfer_gains, state, in);
    std::fwrite(&feet, sizeof feet, 1, stdout);
    for (const double own : {20.0, 50.0}) {  // softer and stiffer than what is safe
      const double kp = mjx_climb::safe_kp(mjx_climb::load_transfer_gains, state, own);
      std::fwrite(&kp, sizeof kp, 1, stdout);
    }
  }
}
