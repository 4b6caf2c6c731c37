// Choices by name, as scripts make them.
#pragma once

#include <fmt/ranges.h>

#include <algorithm>
#include <initializer_list>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace quicksand::fluid {

// The words for the values of a choice, both ways.
template <class T>
using Words = std::initializer_list<std::pair<const char*, T>>;

template <class T>
T one_of(const char* what, const std::string& name, const Words<T>& known) {
  std::vector<std::string> names;
  for (const auto& [word, value] : known) {
    if (name == word) return value;
    names.emplace_back(word);
  }
  throw std::invalid_argument(fmt::format("{} must be one of {}, got \"{}\"", what, names, name));
}

template <class T>
const char* word_for(T value, const Words<T>& known) {
  return std::find_if(known.begin(), known.end(), [&](const auto& pair) { return pair.second == value; })->first;
}

}  // namespace quicksand::fluid
