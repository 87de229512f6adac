#include "cpu/quota.h"

#include <algorithm>
#include <climits>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <limits>

namespace ar::cpu {
namespace {

/// What a small file holds, "" where there is none. Read by C's functions: streams of C++ have crashed where a compiler
/// links a libstdc++ of its own into the extension.
std::string content_of(const std::string& path) {
  std::string content(1 << 16, ' ');
  std::FILE* const file = std::fopen(path.c_str(), "r");
  content.resize(file ? std::fread(content.data(), 1, content.size(), file) : 0);
  if (file) std::fclose(file);
  return content;
}

/// CPUs that the group of this folder has: version 2 of control groups keeps one file, version 1 two.
double quota_of(const std::string& folder) {
  long long quota = 0, period = 0;  // us in a period
  // Where there is no such file, or no limit ("max"):
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
    const std::string line = groups.substr(begin, end - begin);  // number:controllers:/path
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
