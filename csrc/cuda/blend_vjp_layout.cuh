// How the kernel of blend_vjp for up to four channels shares its work out: what a warp takes, and what its lanes hold
// in registers.
#pragma once

#include "cuda/composite.cuh"

namespace ar::cuda {

/// What a kernel of blend_vjp sums: gradients, MeanSums, or both at once.
enum class Sums { kGrads, kMeans, kBoth };

/// Samples of a pixel that a warp of blend_vjp takes. More are shared out to the warps of a block: one warp would be
/// busy for long with their chunk. Only MeanSums need a pixel's sum at once.
template <class F, Sums kSums>
inline constexpr int kVjpSamples = F::kSamples <= 4 || kSums == Sums::kMeans ? F::kSamples : 4;

/// Warps that share a chunk, each with its own samples.
template <class F, Sums kSums> inline constexpr int kVjpGroup = F::kSamples / kVjpSamples<F, kSums>;

/// Whether each lane of blend_vjp holds its eight pixels of a tile in registers, where one sample and three channels
/// leave room for a splat, and not in shared memory. Then a visit of a subtile neither waits for shared memory nor has
/// instructions that read and write it, which is worth the warps that there are fewer of on an SM.
template <class F, int C>
inline constexpr bool kHoldsPixels = F::kSamples == 1 && C == 3 && sizeof(TileSplat<F, C>) <= 112;

/// Whether it holds what blending carries through those pixels, for all samples, in registers. Then each subtile has
/// code of its own, and there is room in shared memory to add up the sums of several pairs together. Not with two
/// samples, as then twice as many warps fit without.
template <class F, int C>
inline constexpr bool kHoldsSamples =
    kHoldsPixels<F, C> || (F::kSamples == 4 && C == 3 && sizeof(TileSplat<F, C>) <= 64);

/// Whether it takes two subtiles, one below the other, under one branch: 8x8 pixels. Then two pixels of a lane have
/// instructions that do not wait for each other, and there are half as many branches, each of which waits for a uniform
/// register. Where weights are expensive, subtiles that are visited in vain cost more than that gains.
template <class F, int C> inline constexpr bool kTakesTwo = kHoldsPixels<F, C> && !F::kExpensive;

/// Whether each subtile has code of its own: where that is short, or pixels are in registers. Of 58 instructions 11
/// would work out where a subtile's pixels are.
template <class F, int C>
inline constexpr bool kUnrollsSubtiles = kHoldsSamples<F, C> || (F::kSamples == 1 && sizeof(TileSplat<F, C>) <= 48);

/// Blocks of blend_vjp that an SM should hold: bounds the registers. Where lanes hold pixels, a fifth block would leave
/// them too few registers, and each chunk would take so much longer that the last ones end later.
template <class F, int C>
inline constexpr int kVjpBlocks = F::kSamples > 1                 ? (kHoldsSamples<F, C> ? 11 : 1)
                                  : kHoldsPixels<F, C>            ? 4
                                  : sizeof(TileSplat<F, C>) <= 48 ? 6
                                                                  : 5;

/// Warps of a block of blend_vjp: as many as leave room for a few blocks in shared memory.
template <class F, Sums kSums>
inline constexpr int kVjpWarps = kVjpGroup<F, kSums> > 1 ? kVjpGroup<F, kSums>
                                 : F::kSamples <= 2      ? 4
                                 : F::kSamples == 8      ? 2
                                                         : 1;

/// Whether a warp has a chunk for itself. Then it takes the next one when it is done, and need not wait for the others
/// of its block, which have other chunks. Warps that share a chunk end with their block.
template <class F, Sums kSums> inline constexpr bool kTakesChunks = kVjpGroup<F, kSums> == 1;

}  // namespace ar::cuda
