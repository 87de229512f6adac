# Finds what the CMake build needs on the system. Nothing is downloaded, nothing is vendored.

set(THREADS_PREFER_PTHREAD_FLAG ON)
find_package(Threads REQUIRED)
find_package(OpenMP COMPONENTS CXX)

if(BUILD_TESTING)
  find_package(GTest QUIET)
  if(NOT GTest_FOUND)
    message(FATAL_ERROR
      "GoogleTest was not found. Install it (Debian, Ubuntu: libgtest-dev; Fedora: gtest-devel; conda: gtest; "
      "macOS: googletest) or leave the tests out with -DBUILD_TESTING=OFF.")
  endif()

  # The CUDA toolkit is optional and no GPU is needed: a test compiles the kernels.
  find_program(AR_NVCC nvcc HINTS ENV CUDA_HOME ENV CUDA_PATH PATHS /usr/local/cuda PATH_SUFFIXES bin)
  if(NOT AR_NVCC)
    message(STATUS "nvcc was not found: the test cuda_kernels, which compiles them, is left out.")
  endif()
  find_package(CUDAToolkit QUIET)  # its headers
endif()
