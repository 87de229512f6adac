"""The platform tag that is true of a wheel: manylinux_2_N, by what its libraries need of the system (PEP 600).

    python wheels/platform_tag.py WHEEL

prints the tag and what decides it. Libraries of torch and CUDA do not count: they are those of the torch that the
wheel requires. Needs readelf, which comes with every compiler.
"""

import platform
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

OF_TORCH = re.compile(r"lib(torch\w*|c10\w*|cudart\w*|gomp(-\w+)?)\.so(\.\d+)*")
OF_SYSTEM = re.compile(r"(ld-linux-[\w-]+|lib(c|m|dl|pthread|rt|gcc_s|stdc\+\+))\.so(\.\d+)?")
# Which glibc has a system whose libraries have these versions: of distributions with that glibc, by PEP 600's rule that
# a wheel must run on all of them.
GLIBC_WITH_GLIBCXX = ((19, 17), (22, 24), (24, 27), (28, 31), (29, 34), (30, 35), (33, 39))
"""(n, m): GLIBCXX_3.4.n is there from glibc 2.m on."""


def dynamic_section(library: Path) -> tuple[set[str], set[str]]:
    """The names of the libraries that a library needs, and the versions of symbols that it needs of them."""
    text = subprocess.check_output(["readelf", "-dVW", str(library)], text=True)
    needed = set(re.findall(r"\(NEEDED\).*\[(.+)\]", text))
    versions = text[text.index("Version needs section") :] if "Version needs section" in text else ""
    return needed, set(re.findall(r"Name: (\S+)", versions))


def least_glibc(versions: set[str]) -> tuple[int, str]:
    """The least n of glibc 2.n on which these versions of symbols are there, and the version that decides it.

    Raises ValueError for a version newer than the table.
    """
    least = (17, "manylinux2014")
    for version in sorted(versions):
        if version == "GLIBC_ABI_DT_RELR":
            least = max(least, (36, version))
        elif match := re.fullmatch(r"GLIBC_2\.(\d+)(\.\d+)?", version):
            least = max(least, (int(match[1]), version))
        elif match := re.fullmatch(r"GLIBCXX_3\.4\.(\d+)", version):
            found = next((m for n, m in GLIBC_WITH_GLIBCXX if int(match[1]) <= n), None)
            if found is None:
                raise ValueError(f"{version} is newer than the table of wheels/platform_tag.py")
            least = max(least, (found, version))
    return least


def platform_tag(wheel: Path) -> tuple[str, str, set[str]]:
    """The tag of a wheel, the version of a symbol that decides it, and all libraries that it needs.

    Raises:
        ValueError: It needs a library that is neither torch's nor that of every system.
    """
    needed, versions = set(), set()
    with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(wheel) as archive:
        for name in archive.namelist():
            if name.endswith(".so"):
                found = dynamic_section(Path(archive.extract(name, folder)))
                needed |= found[0]
                versions |= found[1]
    strange = sorted(name for name in needed if not OF_TORCH.fullmatch(name) and not OF_SYSTEM.fullmatch(name))
    if strange:
        raise ValueError(f"{wheel} needs {', '.join(strange)}, which other systems may not have")
    minor, because = least_glibc(versions)
    return f"manylinux_2_{minor}_{platform.machine()}", because, needed


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    try:
        tag, because, needed = platform_tag(Path(sys.argv[1]))
    except (ValueError, OSError) as error:
        sys.exit(f"error: {error}")
    print(f"{tag}, because of {because}; needs {', '.join(sorted(needed))}")
