// A user's mistake: std::invalid_argument (ValueError in Python) that names function, rule, value and unit. As in grains, which this folder
// may not know.
#pragma once

#include <Eigen/Core>
#include <fmt/format.h>

#include <stdexcept>
#include <string>

namespace quicksand::meshes {

template <class... Args>
[[noreturn]] void fail(fmt::format_string<Args...> rule, Args&&... args) {
  throw std::invalid_argument(fmt::format(rule, std::forward<Args>(args)...));
}

// "(0.1, 0.2)"
template <class Vector>
std::string place(const Vector& x) {
  return fmt::format("({:.6g})", fmt::join(x.data(), x.data() + x.size(), ", "));
}

}  // namespace quicksand::meshes
