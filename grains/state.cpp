// The whole state of a scene as bytes: what the next step reads, so that a restored scene goes on bit for bit. Arrays are written as
// they lie in memory: for the same version on the same kind of machine, no format for exchange.
#include "errors.hpp"
#include "simulation.hpp"

#include <cstring>

namespace quicksand {

namespace {

constexpr std::string_view version = QUICKSAND_VERSION;

class Writer {
 public:
  std::vector<char> bytes;

  template <class T>
  void operator()(T& value) {
    put(&value, sizeof value);
  }
  template <class T>
  void operator()(std::vector<T>& values) {
    const std::uint64_t header[2] = {values.size(), sizeof(T)};
    put(header, sizeof header);
    put(values.data(), values.size() * sizeof(T));
  }
  void operator()(std::vector<std::string>& values) {
    std::uint64_t n = values.size();
    (*this)(n);
    for (const std::string& value : values) {
      std::vector<char> text(value.begin(), value.end());
      (*this)(text);
    }
  }

 private:
  void put(const void* from, std::size_t n) {
    const char* c = static_cast<const char*>(from);
    bytes.insert(bytes.end(), c, c + n);
  }
};

class Reader {
 public:
  explicit Reader(std::span<const char> bytes) : left_(bytes) {}
  bool at_end() const { return left_.empty(); }

  template <class T>
  void operator()(T& value) {
    get(&value, sizeof value);
  }
  template <class T>
  void operator()(std::vector<T>& values) {
    std::uint64_t header[2];
    get(header, sizeof header);
    if (header[1] != sizeof(T) || header[0] > left_.size() / sizeof(T)) fail("restore: the state is damaged");
    values.resize(header[0]);
    get(values.data(), values.size() * sizeof(T));
  }
  void operator()(std::vector<std::string>& values) {
    std::uint64_t n;
    (*this)(n);
    values.clear();
    for (std::uint64_t k = 0; k < n; ++k) {
      std::vector<char> text;
      (*this)(text);
      values.emplace_back(text.begin(), text.end());
    }
  }

 private:
  void get(void* to, std::size_t n) {
    if (n > left_.size()) fail("restore: the state is damaged: at least {} bytes are missing", n - left_.size());
    if (n > 0) std::memcpy(to, left_.data(), n);
    left_ = left_.subspan(n);
  }
  std::span<const char> left_;
};

}  // namespace

template <int dim>
template <class Archive>
void Neighbours<dim>::visit_state(Archive&& a) {
  a(pairs), a(wall_pairs), a(blocks), a(colours), a(shifts), a(found);
  a(skin_), a(x_found_), a(cells_), a(around_), a(cell_start_), a(cell_mean_), a(cell_spread_), a(cell_wall_gap_), a(cell_facet_gap_);
}

template <int dim>
template <class Archive>
void Simulation<dim>::visit_state(Archive&& a) {
  a(settings), a(gravity), a(box_), a(time_), a(last_h_), a(n_free_), a(n_fixed_), a(walls_), a(places_checked_);
  a(grains_.x), a(grains_.body), a(grains_.r), a(grains_.id), a(grains_.wall), a(grains_.material), a(grains_.force);
  a(grains_.inertia), a(materials_.names_), a(materials_.pairs_);
  a(drag_.coefficient), a(drag_.velocity), a(drag_.added_mass), a(drag_.impulse), a(drag_.contact_impulse), a(drag_.in_contact);
  neighbours_.visit_state(a);
  a(contacts_), a(wall_contacts_), a(count_);  // contacts() between two steps
}

template <int dim>
std::vector<char> Simulation<dim>::state() const {
  Writer writer;
  std::vector<std::string> header{std::string("quicksand grains"), std::string(version), std::to_string(dim)};
  writer(header);
  const_cast<Simulation&>(*this).visit_state(writer);  // a Writer changes nothing
  return std::move(writer.bytes);
}

template <int dim>
void Simulation<dim>::restore(std::span<const char> state) {
  Reader reader(state);
  std::vector<std::string> header;
  reader(header);
  if (header.size() != 3 || header[0] != "quicksand grains") fail("restore: this is no state of a scene of grains");
  if (header[1] != version) fail("restore: a state of version {}, but this is version {}; restart with that version", header[1], version);
  if (header[2] != std::to_string(dim)) fail("restore: a scene in {} dimensions, but this one has {}", header[2], dim);
  Simulation restored(box_.period);
  restored.visit_state(reader);
  if (!reader.at_end()) fail("restore: the state is damaged: it is too long");
  restored.settings.threads = settings.threads;  // of this machine
  *this = std::move(restored);
}

template std::vector<char> Simulation<2>::state() const;
template std::vector<char> Simulation<3>::state() const;
template void Simulation<2>::restore(std::span<const char>);
template void Simulation<3>::restore(std::span<const char>);

}  // namespace quicksand
