#include "cuda_on_host.h"

#include <gtest/gtest.h>

#include "cuda/launch.cuh"

namespace ar::cuda {
namespace {

TEST(Launch, AsksEachDeviceOnceHowManyMultiprocessorsItHas) {
  const int before = cuda_on_host::attributes_asked;
  for (int round = 0; round < 3; ++round) {
    for (const int device : {5, 9}) {
      cuda_on_host::device = device;
      EXPECT_EQ(multiprocessors(), unsigned(cuda_on_host::kMultiprocessors));
    }
  }
  EXPECT_EQ(cuda_on_host::attributes_asked - before, 2);
  cuda_on_host::device = kMaxDevices;  // one that is not remembered
  for (int round = 0; round < 2; ++round) EXPECT_EQ(multiprocessors(), unsigned(cuda_on_host::kMultiprocessors));
  EXPECT_EQ(cuda_on_host::attributes_asked - before, 4);
  cuda_on_host::device = 0;
}

}  // namespace
}  // namespace ar::cuda
