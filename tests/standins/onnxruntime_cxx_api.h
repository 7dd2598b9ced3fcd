// What examples/libfranka/loop.cpp calls of ONNX Runtime's C++ API, declared as there. The policy behind it asks for a
// constant action, and stalls or fails where script.h says so.
#pragma once
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <thread>
#include <vector>

#include "script.h"

enum OrtAllocatorType { OrtArenaAllocator };
enum OrtMemType { OrtMemTypeDefault };
enum OrtLoggingLevel { ORT_LOGGING_LEVEL_WARNING };
struct OrtMemoryInfo;

namespace Ort {

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
  std::vector<float> numbers;
  template <typename T>
  static Value CreateTensor(const OrtMemoryInfo*, T*, std::size_t, const int64_t*, std::size_t) {
    return {};
  }
  template <typename T>
  const T* GetTensorData() const {
    return numbers.data();
  }
};
struct Session {
  long calls = 0;
  Session(const Env&, const void*, std::size_t, const SessionOptions&) {}
  std::vector<Value> Run(const RunOptions&, const char* const*, const Value*, std::size_t, const char* const*,
                         std::size_t) {
    ++calls;  // the first is made before there is a motion
    if (calls == asked("fail_at")) throw std::runtime_error("as asked");
    if (calls == asked("stall_at"))
      std::this_thread::sleep_for(std::chrono::milliseconds(static_cast<long>(asked("stall_ms"))));
    return {Value{std::vector<float>(64, static_cast<float>(asked("action")))}};
  }
};

}  // namespace Ort
