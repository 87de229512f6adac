// The CPU quota of a container, which is not its number of cores.
#pragma once

#include <string>

namespace ar::cpu {

/// The least of the process's control group and the groups above, rounded up. INT_MAX: no limit. `root`: prefix of
/// /proc and /sys, for tests.
int cpu_quota(const std::string& root = "");

}  // namespace ar::cpu
