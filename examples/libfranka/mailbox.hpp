// The newest value from one thread to another, without a lock: neither ever waits for the other.
#pragma once
#include <array>
#include <atomic>

template <typename Value>
class Mailbox {
 public:
  // The writer puts a value in the place of one that was not taken.
  void put(const Value& value) {
    places_[back_] = value;
    back_ = middle_.exchange(back_ | fresh, std::memory_order_acq_rel) & ~fresh;
  }

  // The reader takes the newest value; false: there is none since the last one.
  bool take(Value& value) {
    if (!(middle_.load(std::memory_order_relaxed) & fresh)) return false;
    front_ = middle_.exchange(front_, std::memory_order_acq_rel) & ~fresh;
    value = places_[front_];
    return true;
  }

 private:
  static constexpr int fresh = 4;
  std::array<Value, 3> places_{};  // one of the writer, one of the reader, and between them the newest
  std::atomic<int> middle_{1};
  int back_ = 0, front_ = 2;
  static_assert(std::atomic<int>::is_always_lock_free);
};
