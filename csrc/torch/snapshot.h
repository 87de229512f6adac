// Writes the arguments of a failed op to a file, for settings with debug=True.
#pragma once

#include <torch/csrc/jit/serialization/pickle.h>

#include <cstdio>
#include <optional>
#include <string>
#include <vector>

#include "torch/boxing.h"

namespace ar::ops {

/// Before the op runs, because after an error a device may give nothing back.
class Snapshot {
 public:
  template <class Arguments> Snapshot(Arguments& arguments, bool debug, const char* path) : path_(path) {
    if (!debug) return;
    copy_.emplace(c10::StringType::get(), c10::AnyType::get());
    arguments.each([&](std::string_view declaration, auto& value) {
      copy_->insert(std::string(name_of(declaration)), copy_of(value));
    });
  }

  template <class Work> auto guard(const Work& work) const {
    try {
      return work();
    } catch (...) {
      if (copy_) write();
      throw;
    }
  }

 private:
  static IValue copy_of(const IValue& value) {
    if (value.isTensor()) return value.toTensor().defined() ? IValue(value.toTensor().detach().cpu()) : IValue();
    if (!value.isList()) return value;
    c10::impl::GenericList copies(value.toList().elementType());
    for (const IValue& member : value.toListRef()) copies.push_back(copy_of(member));
    return copies;
  }

  void write() const {
    const std::vector<char> bytes = torch::jit::pickle_save(IValue(*copy_));
    if (std::FILE* file = std::fopen(path_, "wb")) {
      std::fwrite(bytes.data(), 1, bytes.size(), file);
      std::fclose(file);
    }
  }

  const char* path_;
  std::optional<c10::impl::GenericDict> copy_;
};

}  // namespace ar::ops
