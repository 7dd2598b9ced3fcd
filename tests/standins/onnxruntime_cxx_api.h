// What examples/libfranka/loop.cpp calls of ONNX Runtime's C++ API, declared as there; it does nothing.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

enum OrtAllocatorType { OrtArenaAllocator };
enum OrtMemType { OrtMemTypeDefault };
enum OrtLoggingLevel { ORT_LOGGING_LEVEL_WARNING };
struct OrtAllocator;
struct OrtMemoryInfo;

namespace Ort {

struct AllocatorWithDefaultOptions {
  operator OrtAllocator*() const { return nullptr; }
};
struct AllocatedFree {
  void operator()(void*) const {}
};
using AllocatedStringPtr = std::unique_ptr<char, AllocatedFree>;
struct Env {
  Env(OrtLoggingLevel, const char*) {}
};
struct SessionOptions {
  SessionOptions& SetIntraOpNumThreads(int) { return *this; }
};
struct RunOptions {
  explicit RunOptions(std::nullptr_t) {}
};
struct MemoryInfo {
  static MemoryInfo CreateCpu(OrtAllocatorType, OrtMemType) { return {}; }
  operator const OrtMemoryInfo*() const { return nullptr; }
};
struct Value {
  template <typename T>
  static Value CreateTensor(const OrtMemoryInfo*, T*, std::size_t, const int64_t*, std::size_t) {
    return {};
  }
  template <typename T>
  const T* GetTensorData() const {
    return nullptr;
  }
};
struct ModelMetadata {
  AllocatedStringPtr LookupCustomMetadataMapAllocated(const char*, OrtAllocator*) const { return nullptr; }
};
struct Session {
  Session(const Env&, const char*, const SessionOptions&) {}
  ModelMetadata GetModelMetadata() const { return {}; }
  std::vector<Value> Run(const RunOptions&, const char* const*, const Value*, std::size_t, const char* const*,
                         std::size_t) {
    return {};
  }
};

}  // namespace Ort
