// A user's mistake: std::invalid_argument (ValueError in Python) that names function, rule, value and unit.
#pragma once

#include <fmt/format.h>

#include <cmath>
#include <stdexcept>
#include <string_view>

namespace quicksand {

template <class... Args>
[[noreturn]] void fail(fmt::format_string<Args...> rule, Args&&... args) {
  throw std::invalid_argument(fmt::format(rule, std::forward<Args>(args)...));
}

// Beyond 1e30, in SI units, products of a few quantities leave the range of double: as bad as infinity, and no such grain exists.
inline bool is_finite(double value) { return std::abs(value) < 1e30; }

// "add: density must be > 0 kg/m^3, got 0", and with the number of a grain "... (grain 17)".
inline void check_positive(double value, std::string_view what, std::string_view unit, std::ptrdiff_t grain = -1) {
  if (value > 1e-30 && value < 1e30) return;
  const std::string at = grain < 0 ? "" : fmt::format(" (grain {})", grain);
  if (value > 0) fail("{} must be between 1e-30 and 1e30 {}, got {}{}", what, unit, value, at);
  fail("{} must be > 0 {}, got {}{}", what, unit, value, at);
}

}  // namespace quicksand
