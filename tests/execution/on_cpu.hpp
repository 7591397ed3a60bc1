// What a kernel of `mjx_climb.execution.cuda_writer` needs to run on a CPU: a thread for each lane of few robots, which
// wait for each other where lanes change values.
#include <barrier>
#include <cmath>
#include <cstddef>
#include <cstring>
#include <thread>
#include <vector>

#define __device__
#define __forceinline__ inline
#define __global__
#define __constant__ static
#define __shared__ static
#define __launch_bounds__(...)
#define __builtin_assume(...)

struct Place { unsigned x; };
static thread_local Place threadIdx;
static Place blockIdx, blockDim;
static std::barrier<> *all;
static int changed[32];

static void __syncthreads() { all->arrive_and_wait(); }
static int __float_as_int(float v) { int w; std::memcpy(&w, &v, 4); return w; }
static float __int_as_float(int w) { float v; std::memcpy(&v, &w, 4); return v; }
static void atomicAdd(float *sum, float v) { *sum += v; }
static int __ldcg(const int *word) { return *word; }
static void __stcg(int *word, int v) { *word = v; }
static int __clz(int v) { return v ? __builtin_clz(v) : 32; }
static int __popc(int v) { return __builtin_popcount(v); }
static float rsqrtf(float v) { return 1.0f / sqrtf(v); }
static float erfinvf(float v) {  // by Newton's method
  float x = 0;
  for (int i = 0; i < 60; ++i) x -= (erff(x) - v) * 0.886226925f * expf(x * x);
  return x;
}
template <class T> T __shfl_sync(unsigned, T v, int source, int width) {
  const int own = threadIdx.x % width, first = threadIdx.x - own;
  std::memcpy(&changed[threadIdx.x], &v, 4);
  all->arrive_and_wait();
  std::memcpy(&v, &changed[first + source], 4);
  all->arrive_and_wait();
  return v;
}
template <class T> T __shfl_xor_sync(unsigned m, T v, int distance, int width) {
  return __shfl_sync(m, v, (int)(threadIdx.x % width) ^ distance, width);
}

static bool __any_sync(unsigned, bool v) {
  changed[threadIdx.x] = v;
  all->arrive_and_wait();
  bool any = false;
  for (unsigned lane = 0; lane < blockDim.x; ++lane) any |= changed[lane] != 0;
  all->arrive_and_wait();
  return any;
}

template <class Kernel, class... Arguments> static void run(Kernel kernel, int threads, Arguments... given) {
  std::barrier<> meeting(threads);
  blockDim.x = threads;
  all = &meeting;
  std::vector<std::thread> lanes;
  for (int lane = 0; lane < threads; ++lane)
    lanes.emplace_back([=] { threadIdx.x = lane; kernel(given...); });
  for (auto &lane : lanes) lane.join();
}
