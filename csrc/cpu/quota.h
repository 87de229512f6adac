// The CPU quota of a container, which the number of cores does not tell.
#pragma once

#include <string>

namespace ar::cpu {

/// So many CPUs, rounded up, the control groups of this process give it: the least of its own group and of those that
/// this one is in. INT_MAX where there is no limit, or no such groups. `root` comes before the paths of /proc and /sys.
int cpu_quota(const std::string& root = "");

}  // namespace ar::cpu
