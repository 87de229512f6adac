// Tensors as structs of the CUDA kernels. SplatMemory, PairMemory and PlanMemory put arrays into one tensor: each costs
// the host microseconds. Checks sizes that checks.h cannot know.
#pragma once

#include <utility>

#include "cuda/dispatch.h"
#include "torch/backend.h"

namespace ar::ops {

/// Structs in a tensor of int32.
template <class Element> Element* structs_of(const Tensor& t) {
  return reinterpret_cast<Element*>(pointer<int32_t>(t));
}
template <class Element> const Element* const_structs_of(const Tensor& t) {
  return reinterpret_cast<const Element*>(const_pointer<int32_t>(t));
}
inline const cuda::Counts* counts_of(const ListTensors& lists) {
  return reinterpret_cast<const cuda::Counts*>(const_pointer<int64_t>(lists.counts));
}

/// Hands out parts of memory in order. Without memory it counts bytes.
class MemoryParts {
 public:
  explicit MemoryParts(const Tensor& memory)
      : begin_(memory.defined() ? static_cast<std::byte*>(memory.data_ptr()) : nullptr) {}

  template <class Element> Element* take(int64_t count) {
    const int64_t first = bytes_;
    bytes_ += (count * int64_t(sizeof(Element)) + kAlignment - 1) / kAlignment * kAlignment;
    return begin_ ? reinterpret_cast<Element*>(begin_ + first) : nullptr;
  }
  int64_t bytes() const { return bytes_; }

 private:
  /// As tensors are: 128 bytes of a warp in two cache lines are two reads.
  static constexpr int64_t kAlignment = 512;

  std::byte* begin_;
  int64_t bytes_ = 0;
};

/// Memory for Parts(memory, arguments...), and its parts.
template <class Parts, class... Arguments>
std::pair<Tensor, Parts> make_memory(const at::TensorOptions& bytes, const Arguments&... arguments) {
  const Tensor memory = at::empty({Parts(Tensor(), arguments...).bytes}, bytes);
  return {memory, Parts(memory, arguments...)};
}

/// What `project` or `shape_rows` and bin write.
struct SplatMemory {
  std::byte *depth_scratch, *emit_scratch;
  cuda::ZeroedMemory to_clear = {};  ///< Both, without the histograms, which are clear.
  uint32_t* keys[2];                 ///< Of depth, and a second buffer.
  int32_t* order;                    ///< A second buffer.
  cuda::SplatTiles* tiles;
  int64_t bytes;

  SplatMemory(const Tensor& memory, int64_t n) {
    MemoryParts parts(memory);
    constexpr int64_t kHistograms = cuda::kDepthHistogramWords * sizeof(uint32_t);
    const int64_t depth_bytes = cuda::depth_sort_scratch(n), emit_bytes = cuda::emit_scratch(n);
    depth_scratch = parts.take<std::byte>(depth_bytes + emit_bytes);
    emit_scratch = depth_scratch ? depth_scratch + depth_bytes : nullptr;
    if (depth_scratch) to_clear = {depth_scratch + kHistograms, depth_bytes - kHistograms + emit_bytes};
    for (uint32_t*& k : keys) k = parts.take<uint32_t>(n);
    order = parts.take<int32_t>(n);
    tiles = parts.take<cuda::SplatTiles>(n);
    bytes = parts.bytes();
  }
};

/// Of pairs while they are sorted by tile.
struct PairMemory {
  cuda::ZeroedMemory scratch;
  uint32_t* tiles[2];
  std::byte* values;  ///< SlotPair, or int32_t without a backward pass.
  int64_t bytes;

  PairMemory(const Tensor& memory, int64_t capacity, TileGrid grid, bool with_slots) {
    MemoryParts parts(memory);
    scratch.bytes = cuda::tile_sort_scratch(capacity, grid);
    scratch.data = parts.take<std::byte>(scratch.bytes);
    for (uint32_t*& t : tiles) t = parts.take<uint32_t>(capacity);
    values = parts.take<std::byte>(capacity * int64_t(with_slots ? sizeof(cuda::SlotPair) : sizeof(int32_t)));
    bytes = parts.bytes();
  }
};

/// Of blend while it runs.
struct PlanMemory {
  cuda::TileChunk* tail;
  int32_t *tile_order, *tile_planes, *tile_open, *open_tiles;
  int64_t bytes;

  PlanMemory(const Tensor& memory, int64_t tiles, int64_t chunks) {
    MemoryParts parts(memory);
    tail = parts.take<cuda::TileChunk>(chunks + 1);
    for (int32_t** t : {&tile_order, &tile_planes, &tile_open}) *t = parts.take<int32_t>(tiles);
    open_tiles = parts.take<int32_t>(tiles);
    bytes = parts.bytes();
  }
  void set(cuda::BlendParams& p) const {
    p.plan.tail = tail;
    p.plan.tile_order = tile_order;
    p.plan.tile_planes = tile_planes;
    p.tile_open = tile_open;
    p.open_tiles = open_tiles;
  }
};

inline constexpr int64_t kCountsWidth = ListTensors::kCountsWidth, kChunkWidth = BlendState::kChunkWidth;
static_assert(sizeof(cuda::Counts) == kCountsWidth * sizeof(int64_t));
static_assert(sizeof(cuda::SlotPair) == ListTensors::kPairWidth * sizeof(int32_t));
static_assert(sizeof(cuda::PairRange) == ListTensors::kRangeWidth * sizeof(int32_t));
static_assert(sizeof(cuda::TileChunk) == kChunkWidth * sizeof(int32_t));

/// BlendState::chunks: the PlanState in whole rows, then TileChunks, then CutLists.
inline constexpr int64_t kPlanRows = (sizeof(cuda::PlanState) / sizeof(int32_t) + kChunkWidth - 1) / kChunkWidth;

inline cuda::TileLists tile_lists_of(const ListTensors& lists) {
  cuda::TileLists out = {};
  out.pairs = const_pointer<int32_t>(lists.pairs);
  out.stride = int(lists.pairs.size(1));
  out.tile_offsets = const_pointer<int64_t>(lists.tile_offsets);
  out.counts = counts_of(lists);
  out.n = lists.ids.numel();
  out.capacity = lists.pairs.size(0);
  return out;
}

inline cuda::PairSumsView pair_sums_of(const ListTensors& lists, const Tensor& pair_grads) {
  cuda::PairSumsView out = {};
  out.n = lists.ids.numel();
  out.ranges = const_structs_of<cuda::PairRange>(lists.splat_offsets);
  out.counts = counts_of(lists);
  out.capacity = lists.pairs.size(0);
  out.pair_grads = const_pointer<float>(pair_grads);
  return out;
}

/// Null `data`: the three colours in the splats.
inline Channels<float> channels_of(const ChannelTensors& channels) {
  Channels<float> out = {};
  out.count = int(channels.count);
  if (!channels.rows.defined()) return out;
  // Row i is that of splat i: every Gaussian has one. No pair reads kNoRow.
  static const float kNoRow = 0;
  out.data = channels.rows.numel() ? const_pointer<float>(channels.rows) : &kNoRow;
  out.stride = channels.count;
  return out;
}

inline void check_counts(const ListTensors& lists) {
  TORCH_CHECK_VALUE(lists.counts.numel() == kCountsWidth, "counts must be what bin returned, got shape ",
                    lists.counts.sizes());
}
/// The same for `blend` and `blend_vjp`.
inline cuda::Route route_of(const ListTensors& lists, const Pass& pass, int64_t channels) {
  return cuda::route_of(pass.footprint.choice.index, channels, lists.pairs.size(0), pass.grid,
                        cuda::multiprocessors_of_device(), pass.footprint.along_rays());
}
inline int64_t max_chunks(const Tensor& chunks, const cuda::ListCut& cut) {
  return chunks.size(0) - kPlanRows - cut.max_lists;
}
inline void set_plan(cuda::BlendParams& p, const Tensor& chunks, const cuda::ListCut& cut) {
  p.plan.state = structs_of<cuda::PlanState>(chunks);
  p.plan.chunk_order = structs_of<cuda::TileChunk>(chunks) + kPlanRows;
  p.plan.cut_lists = reinterpret_cast<cuda::CutList*>(p.plan.chunk_order + max_chunks(chunks, cut));
}
inline void set_plan(cuda::BlendVjpParams& p, const Tensor& chunks, const cuda::ListCut& cut) {
  p.plan = const_structs_of<cuda::PlanState>(chunks);
  p.chunk_order = const_structs_of<cuda::TileChunk>(chunks) + kPlanRows;
  p.max_chunks = max_chunks(chunks, cut);
  p.cut_lists = reinterpret_cast<const cuda::CutList*>(p.chunk_order + p.max_chunks);
}
inline void check_plan(const BlendState& state, const cuda::ListCut& cut, TileGrid grid) {
  const Tensor& chunks = state.chunks;
  const int64_t rows = kPlanRows + (cut.whole ? cut.max_segments + grid.tiles() + cut.max_lists : 0);
  TORCH_CHECK_VALUE(chunks.dim() == 2 && (cut.whole ? chunks.size(0) == rows : chunks.size(0) >= rows) &&
                        chunks.size(1) == kChunkWidth && chunks.scalar_type() == at::kInt &&
                        state.checkpoints.scalar_type() == at::kFloat,
                    "chunks and checkpoints must be what blend saved, got shape ", chunks.sizes());
}
}  // namespace ar::ops
