#include "cpu/quota.h"

#include <algorithm>
#include <climits>
#include <cmath>
#include <cstdint>
#include <fstream>
#include <limits>

namespace ar::cpu {
namespace {

/// CPUs that the group of this folder has: version 2 of control groups keeps one file, version 1 two.
double quota_of(const std::string& folder) {
  int64_t quota = 0, period = 0;  // us in a period
  std::ifstream both(folder + "/cpu.max");
  if (!(both >> quota >> period)) {  // no such file, or no limit: "max"
    std::ifstream(folder + "/cpu.cfs_quota_us") >> quota;
    std::ifstream(folder + "/cpu.cfs_period_us") >> period;
  }
  return quota > 0 && period > 0 ? double(quota) / double(period) : std::numeric_limits<double>::infinity();
}

}  // namespace

int cpu_quota(const std::string& root) {
  double least = INT_MAX;
  std::ifstream groups(root + "/proc/self/cgroup");
  for (std::string line; std::getline(groups, line);) {  // number:controllers:/path
    const size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos) continue;
    const std::string controllers = line.substr(first + 1, second - first - 1);
    if (!controllers.empty() && ("," + controllers + ",").find(",cpu,") == std::string::npos) continue;
    const std::string mounts[] = {"", "/unified", "/cpu", "/" + controllers};
    for (const std::string& mount : mounts) {
      // A container may see its own group as the root of this tree, and not under its name.
      for (std::string path = line.substr(second + 1);; path.resize(path.rfind('/'))) {
        least = std::min(least, quota_of(root + "/sys/fs/cgroup" + mount + path));
        if (path.empty() || path.find('/') == std::string::npos) break;
      }
    }
  }
  return std::max(1, int(std::ceil(least)));
}

}  // namespace ar::cpu
