// A user's mistake: std::invalid_argument (ValueError in Python) that names function, rule, value and unit.
#pragma once

#include <fmt/format.h>

#include <stdexcept>

namespace quicksand {

template <class... Args>
[[noreturn]] void fail(fmt::format_string<Args...> rule, Args&&... args) {
  throw std::invalid_argument(fmt::format(rule, std::forward<Args>(args)...));
}

}  // namespace quicksand
