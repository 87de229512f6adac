// The CPU quota, in trees of files that look like those of containers.
#include "cpu/quota.h"

#include <gtest/gtest.h>

#include <climits>
#include <filesystem>
#include <fstream>
#include <map>

namespace ar::test {
namespace {

namespace fs = std::filesystem;

struct System {
  const char* name;
  std::map<std::string, std::string> files;
  int quota;
};
void PrintTo(const System& system, std::ostream* out) { *out << system.name; }

const char* const kMine = "/proc/self/cgroup";
const System kSystems[] = {
    {"NoSuchFiles", {}, INT_MAX},
    {"NoLimit", {{kMine, "0::/\n"}, {"/sys/fs/cgroup/cpu.max", "max 100000\n"}}, INT_MAX},
    {"Two", {{kMine, "0::/\n"}, {"/sys/fs/cgroup/cpu.max", "200000 100000\n"}}, 2},
    {"OneAndAHalf", {{kMine, "0::/\n"}, {"/sys/fs/cgroup/cpu.max", "150000 100000\n"}}, 2},
    {"Little", {{kMine, "0::/\n"}, {"/sys/fs/cgroup/cpu.max", "1000 100000\n"}}, 1},
    {"AnotherPeriod", {{kMine, "0::/\n"}, {"/sys/fs/cgroup/cpu.max", "30000 10000\n"}}, 3},
    {"OfTheGroup", {{kMine, "0::/a/b\n"}, {"/sys/fs/cgroup/a/b/cpu.max", "300000 100000\n"}}, 3},
    {"OfAGroupAround",
     {{kMine, "0::/a/b\n"},
      {"/sys/fs/cgroup/a/cpu.max", "200000 100000\n"},
      {"/sys/fs/cgroup/a/b/cpu.max", "900000 100000\n"}},
     2},
    {"UnlimitedInAGroupWithALimit",
     {{kMine, "0::/a/b\n"},
      {"/sys/fs/cgroup/a/cpu.max", "400000 100000\n"},
      {"/sys/fs/cgroup/a/b/cpu.max", "max 100000\n"}},
     4},
    {"OfAnotherGroup", {{kMine, "0::/a\n"}, {"/sys/fs/cgroup/b/cpu.max", "100000 100000\n"}}, INT_MAX},
    {"NameOutsideOfTheContainer", {{kMine, "0::/docker/0123\n"}, {"/sys/fs/cgroup/cpu.max", "200000 100000\n"}}, 2},
    {"GroupOutsideOfTheContainer", {{kMine, "0::/../x\n"}, {"/sys/fs/cgroup/cpu.max", "200000 100000\n"}}, 2},
    {"VersionOne",
     {{kMine, "9:name=systemd:/\n3:cpuset:/\n1:cpu:/a\n0::/\n"},
      {"/sys/fs/cgroup/cpu/a/cpu.cfs_quota_us", "250000\n"},
      {"/sys/fs/cgroup/cpu/a/cpu.cfs_period_us", "100000\n"}},
     3},
    {"VersionOneNoLimit",
     {{kMine, "1:cpu:/\n"},
      {"/sys/fs/cgroup/cpu/cpu.cfs_quota_us", "-1\n"},
      {"/sys/fs/cgroup/cpu/cpu.cfs_period_us", "100000\n"}},
     INT_MAX},
    {"VersionOneWithAccounting",
     {{kMine, "4:cpu,cpuacct:/docker/0123\n"},
      {"/sys/fs/cgroup/cpu,cpuacct/cpu.cfs_quota_us", "50000\n"},
      {"/sys/fs/cgroup/cpu,cpuacct/cpu.cfs_period_us", "100000\n"}},
     1},
    {"OnlySetsOfCpus",  // whose group has the name of one with a quota
     {{kMine, "3:cpuset:/a\n1:cpu:/\n"},
      {"/sys/fs/cgroup/cpu/a/cpu.cfs_quota_us", "100000\n"},
      {"/sys/fs/cgroup/cpu/a/cpu.cfs_period_us", "100000\n"}},
     INT_MAX},
    {"BothVersions", {{kMine, "1:memory:/\n0::/a\n"}, {"/sys/fs/cgroup/unified/a/cpu.max", "200000 100000\n"}}, 2},
    {"Nonsense",
     {{kMine, "\nx\n:\n::\n0::\n0::a\n"},
      {"/sys/fs/cgroup/cpu.max", "-5 0\n"},
      {"/sys/fs/cgroup/cpu.cfs_quota_us", "many"}},
     INT_MAX},
};

class QuotaTest : public ::testing::TestWithParam<System> {};

TEST_P(QuotaTest, IsThatOfTheGroups) {
  const System& system = GetParam();
  const fs::path root = fs::path(::testing::TempDir()) / (std::string("quota_") + system.name);
  fs::remove_all(root);
  for (const auto& [path, text] : system.files) {
    const fs::path file = root.string() + path;
    fs::create_directories(file.parent_path());
    std::ofstream(file) << text;
  }
  EXPECT_EQ(cpu::cpu_quota(root.string()), system.quota);
  fs::remove_all(root);
}

INSTANTIATE_TEST_SUITE_P(Systems, QuotaTest, ::testing::ValuesIn(kSystems),
                         [](const auto& test) { return std::string(test.param.name); });

TEST(QuotaTest, OfThisProcessIsPositive) { EXPECT_GE(cpu::cpu_quota(), 1); }

}  // namespace
}  // namespace ar::test
