// Loops over chunks of Gaussians, splats or weights, which threads share.
#pragma once

#include <algorithm>

#include "cpu/isa.h"
#include "cpu/parallel.h"
#include "cpu/stages.h"

namespace ar::AR_ISA {

/// body(chunk, begin, end) for every chunk of [0, n).
template <class Body> void for_each_chunk(int64_t n, int threads, const Body& body) {
  cpu::parallel_for(cpu::chunks_of(n), threads,
                    [&](int64_t chunk) { body(chunk, chunk * cpu::kChunk, std::min(n, (chunk + 1) * cpu::kChunk)); });
}

}  // namespace ar::AR_ISA
