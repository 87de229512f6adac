// Reads the files of control groups, version 1 or 2.
#include "cpu/quota.h"

#include <algorithm>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <limits>

namespace ar::cpu {
namespace {

/// "" if there is no file. In C: streams crash if the extension has its own libstdc++.
std::string content_of(const std::string& path) {
  std::string content(1 << 16, ' ');
  std::FILE* const file = std::fopen(path.c_str(), "r");
  content.resize(file ? std::fread(content.data(), 1, content.size(), file) : 0);
  if (file) std::fclose(file);
  return content;
}

/// Version 2 has one file, version 1 two.
double quota_of(const std::string& folder) {
  long long quota = 0, period = 0;  // Microseconds.
  // No file, or no limit ("max"):
  if (std::sscanf(content_of(folder + "/cpu.max").c_str(), "%lld %lld", &quota, &period) != 2) {
    std::sscanf(content_of(folder + "/cpu.cfs_quota_us").c_str(), "%lld", &quota);
    std::sscanf(content_of(folder + "/cpu.cfs_period_us").c_str(), "%lld", &period);
  }
  return quota > 0 && period > 0 ? double(quota) / double(period) : std::numeric_limits<double>::infinity();
}

}  // namespace

int cpu_quota(const std::string& root) {
  double least = INT_MAX;
  const std::string groups = content_of(root + "/proc/self/cgroup");
  for (size_t end, begin = 0; (end = groups.find('\n', begin)) != std::string::npos; begin = end + 1) {
    const std::string line = groups.substr(begin, end - begin);  // number:controllers:/path.
    const size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos) continue;
    const std::string controllers = line.substr(first + 1, second - first - 1);
    if (!controllers.empty() && ("," + controllers + ",").find(",cpu,") == std::string::npos) continue;
    const std::string mounts[] = {"", "/unified", "/cpu", "/" + controllers};
    for (const std::string& mount : mounts) {
      // A container may see its group as the root.
      for (std::string path = line.substr(second + 1);; path.resize(path.rfind('/'))) {
        least = std::min(least, quota_of(root + "/sys/fs/cgroup" + mount + path));
        if (path.empty() || path.find('/') == std::string::npos) break;
      }
    }
  }
  return std::max(1, int(std::ceil(least)));
}

}  // namespace ar::cpu
