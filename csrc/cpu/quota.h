// The CPU quota of a container, which is not its number of cores. thread_count() of csrc/torch reads it once.
#pragma once

#include <string>

namespace ar::cpu {

/// The least quota of the process's control group and the groups above, rounded up. INT_MAX: no limit. `root`: prefix
/// of /proc and /sys, for tests.
int cpu_quota(const std::string& root = "");

}  // namespace ar::cpu
