#include "gmsh.hpp"

#include "assemble.hpp"
#include "errors.hpp"

#include <gmsh.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <fstream>
#include <numeric>
#include <set>

namespace quicksand::meshes {

namespace {

// Options that decide what a mesh looks like, with gmsh's defaults: a mesh does not depend on what a live session has set.
constexpr std::array<std::pair<const char*, double>, 17> mesh_options{{{"Mesh.Algorithm", 6},
                                                                       {"Mesh.Algorithm3D", 1},
                                                                       {"Mesh.ElementOrder", 1},
                                                                       {"Mesh.MeshSizeExtendFromBoundary", 1},
                                                                       {"Mesh.MeshSizeFactor", 1},
                                                                       {"Mesh.MeshSizeFromCurvature", 0},
                                                                       {"Mesh.MeshSizeFromPoints", 1},
                                                                       {"Mesh.MeshSizeMax", 1e22},
                                                                       {"Mesh.MeshSizeMin", 0},
                                                                       {"Mesh.Optimize", 1},
                                                                       {"Mesh.OptimizeNetgen", 0},
                                                                       {"Mesh.RandomSeed", 1},
                                                                       {"Mesh.RecombineAll", 0},
                                                                       {"Mesh.Recombine3DAll", 0},
                                                                       {"Mesh.ScalingFactor", 1},
                                                                       {"Mesh.Smoothing", 1},
                                                                       {"Mesh.SubdivisionAlgorithm", 0}}};

double option(const char* name) {
  double value = -1.0;
  gmsh::option::getNumber(name, value);
  return value;
}

// gmsh 4.8 cannot be asked. Before the first initialize its calls leave their results as they were, after a finalize they throw (and print a
// line, unless it was ours).
bool is_alive() {
  try {
    return option("General.Terminal") != -1.0;
  } catch (...) {
    return false;
  }
}

// gmsh made ready and quiet, and on return as it was found. Its errors are collected, not thrown: an error thrown out of its mesher leaves
// it locked for good.
class Session {
 public:
  explicit Session(std::string_view where) : where_(where), mine_(!is_alive()) {
    if (mine_) gmsh::initialize(0, nullptr, false);  // false: no settings of this user's home folder
    set("General.Terminal", 0);
    set("General.AbortOnError", 0);
    gmsh::logger::start();
    const auto log = messages();
    shared_log_ = !log.empty() && log.back().find("already started") != std::string::npos;
    seen_ = log.size();
    gmsh::model::getCurrent(model_);
    models_ = models().size();
  }

  Session(const Session&) = delete;

  ~Session() {
    try {
      for (auto names = models(); names.size() > models_; names = models()) {  // a script may have made others
        gmsh::model::setCurrent(names.back());  // the last of that name
        gmsh::model::remove();
      }
      if (models_ > 0) gmsh::model::setCurrent(model_);
      for (auto it = before_.rbegin(); it != before_.rend(); ++it) gmsh::option::setNumber(it->first, it->second);
      if (!shared_log_) gmsh::logger::stop();
      if (mine_) {
        gmsh::option::setNumber("General.Verbosity", 0);  // else is_alive would print an error from now on
        gmsh::finalize();
      }
    } catch (...) {  // nothing that the caller could do
    }
  }

  const std::string& model() const { return model_; }  // current when the session began

  void new_model() {
    for (const auto& [name, value] : mesh_options) set(name, value);
    gmsh::model::add("quicksand");
  }

  void set(const char* name, double value) {
    before_.emplace_back(name, option(name));
    gmsh::option::setNumber(name, value);
  }

  // Throws what gmsh has complained of since the last call.
  void check() {
    const auto log = messages();
    std::vector<std::string> errors;
    for (std::size_t k = seen_; k < log.size(); ++k)
      if (log[k].starts_with("Error: ") && errors.size() < 3) errors.push_back(log[k].substr(7));
    seen_ = log.size();
    if (!errors.empty()) fail("{}: gmsh says: {}", where_, fmt::join(errors, "; "));
  }

 private:
  static std::vector<std::string> messages() {
    std::vector<std::string> log;
    gmsh::logger::get(log);
    return log;
  }

  static std::vector<std::string> models() {
    std::vector<std::string> names;
    gmsh::model::list(names);
    return names;
  }

  std::string where_, model_;
  bool mine_, shared_log_ = false;
  std::size_t seen_ = 0, models_ = 0;
  std::vector<std::pair<const char*, double>> before_;
};

// Calls of gmsh throw strings and numbers in some versions.
template <class Call>
auto translated(std::string_view where, Call&& call) {
  try {
    return call();
  } catch (const std::string& message) {
    fail("{}: gmsh says: {}", where, message);
  } catch (int code) {
    fail("{}: gmsh gave up with code {}", where, code);
  }
}

struct Elements {
  std::vector<int> types;
  std::vector<std::vector<std::size_t>> tags, nodes;
  Elements(int dim, int tag) { gmsh::model::mesh::getElements(types, tags, nodes, dim, tag); }
};


bool has_elements(int dim) {
  std::vector<int> types;
  gmsh::model::mesh::getElementTypes(types, dim);
  return !types.empty();
}

int dimension_of_mesh() { return has_elements(3) ? 3 : has_elements(2) ? 2 : has_elements(1) ? 1 : 0; }

std::vector<int> group_numbers(int dim, int tag) {
  std::vector<int> numbers;
  gmsh::model::getPhysicalGroupsForEntity(dim, tag, numbers);
  return numbers;
}

// Names of the physical groups that hold an entity; one without a name goes by its number.
std::vector<std::string> groups_of(int dim, int tag) {
  std::vector<std::string> names;
  for (int number : group_numbers(dim, tag)) {
    std::string name;
    gmsh::model::getPhysicalName(dim, number, name);
    names.push_back(name.empty() ? std::to_string(number) : name);
  }
  return names;
}

// In the order of their groups, which becomes that of the names; without a group first.
std::vector<int> entities(int dim) {
  gmsh::vectorpair found;
  gmsh::model::getEntities(found, dim);
  std::vector<std::pair<std::vector<int>, int>> keys;
  for (const auto& [d, tag] : found) keys.emplace_back(group_numbers(dim, tag), tag);
  std::sort(keys.begin(), keys.end());
  std::vector<int> tags;
  for (const auto& [numbers, tag] : keys) tags.push_back(tag);
  return tags;
}

// By their tags: gmsh's own order depends on the file that they come from.
class Nodes {
 public:
  Nodes() {
    std::vector<std::size_t> tags;
    std::vector<double> x, parameters;
    gmsh::model::mesh::getNodes(tags, x, parameters);
    std::vector<std::size_t> order(tags.size());
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [&](auto a, auto b) { return tags[a] < tags[b]; });
    for (std::size_t k : order) {
      tags_.push_back(tags[k]);
      x_.emplace_back(x[3 * k], x[3 * k + 1], x[3 * k + 2]);
    }
  }

  std::size_t size() const { return tags_.size(); }
  const Vec<3>& operator[](std::size_t k) const { return x_[k]; }

  int index(std::size_t tag, std::string_view where) const {
    const auto found = std::lower_bound(tags_.begin(), tags_.end(), tag);
    if (found == tags_.end() || *found != tag) fail("{}: node {} is used and not defined", where, tag);
    return static_cast<int>(found - tags_.begin());
  }

 private:
  std::vector<std::size_t> tags_;  // ascending
  std::vector<Vec<3>> x_;          // [m]
};

// Simplices of an entity of dimension n - 1.
template <std::size_t n>
Entity<n> entity(int tag, std::vector<std::string> groups, const Nodes& nodes, std::string_view where) {
  constexpr int dim = static_cast<int>(n) - 1;
  Entity<n> result{.tag = tag, .groups = std::move(groups), .simplices = {}, .numbers = {}};
  const Elements elements(dim, tag);
  for (std::size_t t = 0; t < elements.types.size(); ++t) {
    if (elements.tags[t].empty()) continue;
    std::string name;
    int element_dim = 0, order = 0, corners = 0, primary = 0;
    std::vector<double> local;
    gmsh::model::mesh::getElementProperties(elements.types[t], name, element_dim, order, corners, local, primary);
    const auto count = elements.tags[t].size();
    if (primary != static_cast<int>(n))
      fail("{}: {} {} is meshed with '{}' elements ({}, the first is {}); only simplices are known, {}: leave out Recombine", where,
           dim == 1   ? "curve"
           : dim == 2 ? "surface"
                      : "volume",
           tag, name, count, elements.tags[t][0], "triangles in 2D and tetrahedra in 3D");
    if (order != 1)
      fail("{}: elements of order {} ('{}', {} of them, the first is {}); only straight ones are known: set Mesh.ElementOrder = 1", where, order,
           name, count, elements.tags[t][0]);
    for (std::size_t e = 0; e < count; ++e) {
      std::array<int, n> simplex;
      for (std::size_t k = 0; k < n; ++k) simplex[k] = nodes.index(elements.nodes[t][n * e + k], where);
      result.simplices.push_back(simplex);
    }
    result.numbers.insert(result.numbers.end(), elements.tags[t].begin(), elements.tags[t].end());
  }
  return result;
}

template <int dim>
std::string side_of(int tag) {
  return fmt::format("{} {}", dim == 2 ? "curve" : "surface", tag);
}

// A side and the one it is an image of, in gmsh's numbers.
struct PeriodicSide {
  int dim, tag, master;
  std::vector<std::size_t> images, originals;  // nodes
  std::vector<double> affine;                  // 4 x 4, or empty
};

std::vector<PeriodicSide> periodic_sides(int dim) {
  std::vector<PeriodicSide> sides;
  for (int tag : entities(dim)) {
    PeriodicSide side{.dim = dim, .tag = tag, .master = tag, .images = {}, .originals = {}, .affine = {}};
    gmsh::model::mesh::getPeriodicNodes(dim, tag, side.master, side.images, side.originals, side.affine);
    if (side.master != tag && !side.images.empty()) sides.push_back(std::move(side));
  }
  return sides;
}

// gmsh 4.8 writes the periodic sides of a .msh 2.2 file, as text in binary files too, and does not read them. Nothing for other versions.
std::vector<PeriodicSide> periodic_sides_of_old_file(const std::filesystem::path& path, std::string_view where) {
  std::ifstream file(path, std::ios::binary);
  std::string line;
  while (std::getline(file, line) && !line.starts_with("$MeshFormat")) {}
  if (!std::getline(file, line) || !line.starts_with("2")) return {};
  while (std::getline(file, line) && !line.starts_with("$Periodic")) {}
  std::vector<PeriodicSide> sides;
  std::size_t count = 0;
  if (!file || !(file >> count)) return {};
  for (std::size_t s = 0; s < count; ++s) {
    PeriodicSide side;
    std::string word;
    file >> side.dim >> side.tag >> side.master >> word;
    if (word == "Affine") {
      side.affine.resize(16);
      for (double& x : side.affine) file >> x;
      file >> word;
    }
    std::size_t image = 0, original = 0;
    for (long n = file ? std::strtol(word.c_str(), nullptr, 10) : 0; n > 0 && file >> image >> original; --n) {
      side.images.push_back(image);
      side.originals.push_back(original);
    }
    if (!file) fail("{}: its $Periodic section ends in the middle, at entry {} of {}", where, s + 1, count);
    if (!side.images.empty()) sides.push_back(std::move(side));
  }
  return sides;
}

// Without a transformation the translation is the mean over the pairs.
template <int dim>
Period<dim> period(const PeriodicSide& side, const Nodes& nodes, std::string_view where) {
  Period<dim> result{.translation = Vec<dim>::Zero(), .pairs = {}, .images = {side.tag}, .masters = {side.master}};
  Vec<3> translation = Vec<3>::Zero();
  for (std::size_t k = 0; k < side.images.size(); ++k) {
    const auto& pair = result.pairs.emplace_back(std::array{nodes.index(side.images[k], where), nodes.index(side.originals[k], where)});
    translation += (nodes[pair[0]] - nodes[pair[1]]) / static_cast<double>(side.images.size());
  }
  if (!side.affine.empty()) {
    const Eigen::Map<const Eigen::Matrix<double, 4, 4, Eigen::RowMajor>> map(side.affine.data());
    if (!(map.topLeftCorner<3, 3>() - Eigen::Matrix3d::Identity()).isZero(1e-9))
      fail("{}: {} is a turned or mirrored image of {}; a period must be a translation", where, side_of<dim>(side.tag), side_of<dim>(side.master));
    translation = map.topRightCorner<3, 1>();
  }
  if (dim == 2 && !(std::abs(translation.z()) <= 1e-9 * translation.norm()))
    fail("{}: the period of {} leaves the plane: its z must be 0 m, got {} m", where, side_of<dim>(side.tag), translation.z());
  result.translation = translation.template head<dim>();
  return result;
}

void check_plane(const Parts<2>& parts, const Nodes& nodes, std::string_view where) {
  double extent = 0.0;
  for (const auto& x : parts.nodes) extent = std::max(extent, (x - parts.nodes[0]).norm());
  for (const auto& body : parts.bodies)
    for (const auto& triangle : body.simplices)
      for (int k : triangle)
        if (!(std::abs(nodes[k].z()) <= 1e-9 * extent))  // rounding of the generator's geometry
          fail("{}: a mesh in 2D lies in the plane z = 0 m, the node at {} m does not; is this the surface of a body in 3D? (A .msh "
               "file holds physical groups only, when there are some: the body needs one, too.)", where,
               place(nodes[k]));
}

// `sides`: where not gmsh but a file knows the periodic ones.
template <int dim>
Mesh<dim> mesh_of_model(std::string_view where, std::vector<PeriodicSide> sides = {}) {
  const int found = dimension_of_mesh();
  if (found != dim && found < 2) fail("{}: there is no {} in this mesh", where, dim == 2 ? "triangle" : "tetrahedron");
  if (found != dim) fail("{}: this is a mesh in {}D, not in {}D", where, found, dim);
  const Nodes nodes;
  Parts<dim> parts;
  parts.nodes.reserve(nodes.size());
  for (std::size_t k = 0; k < nodes.size(); ++k) parts.nodes.push_back(nodes[k].template head<dim>());

  const auto tags = entities(dim);
  const bool grouped = std::any_of(tags.begin(), tags.end(), [](int tag) { return !groups_of(dim, tag).empty(); });
  for (int tag : tags) {
    auto groups = groups_of(dim, tag);
    if (!grouped || !groups.empty()) parts.bodies.push_back(entity<dim + 1>(tag, std::move(groups), nodes, where));
  }
  if constexpr (dim == 2) check_plane(parts, nodes, where);

  std::set<int> periodic;
  if (sides.empty()) sides = periodic_sides(dim - 1);
  for (const auto& side : sides) {
    if (side.dim != dim - 1) continue;
    auto joined = period<dim>(side, nodes, where);
    periodic.insert({side.tag, side.master});
    // Sides of the same period are one: at their rims each may need the pairs of the others.
    const auto same = std::find_if(parts.periods.begin(), parts.periods.end(), [&](const auto& other) {
      return (other.translation - joined.translation).norm() <= 1e-9 * joined.translation.norm();
    });
    if (same == parts.periods.end()) {
      parts.periods.push_back(std::move(joined));
    } else {
      same->pairs.insert(same->pairs.end(), joined.pairs.begin(), joined.pairs.end());
      same->images.push_back(side.tag);
      same->masters.push_back(side.master);
    }
  }
  for (int tag : entities(dim - 1)) {
    auto groups = groups_of(dim - 1, tag);
    if (!groups.empty() || periodic.contains(tag)) parts.sides.push_back(entity<dim>(tag, std::move(groups), nodes, where));
  }
  return assemble(parts, where);
}

AnyMesh any_mesh_of_model(std::string_view where, std::vector<PeriodicSide> sides = {}) {
  if (dimension_of_mesh() == 3) return mesh_of_model<3>(where, std::move(sides));
  return mesh_of_model<2>(where, std::move(sides));
}

// Without a newline at its end gmsh would leave out the last line of a script, and say nothing.
void check_last_line(const std::filesystem::path& path, std::string_view where) {
  std::ifstream file(path, std::ios::binary);
  char last = 0;
  if (file.seekg(-1, std::ios::end) && file.get(last) && last != '\n')
    fail("{}: the last line has no newline at its end, and gmsh would leave it out: add one", where);
}

// Opens a file in a model of its own and hands over to `take`. dim 0: the dimension that it has.
template <class Take>
auto with_file(const std::filesystem::path& path, int dim, Take&& take) {
  const std::string where = fmt::format("read {}", path.string());
  const bool is_script = path.extension() == ".geo";
  if (!is_script && path.extension() != ".msh")
    fail("{}: the name must end in .msh (a mesh) or .geo (a script that gmsh meshes), got '{}'", where, path.extension().string());
  if (!std::filesystem::exists(path))
    throw std::filesystem::filesystem_error("read", path, std::make_error_code(std::errc::no_such_file_or_directory));
  if (std::filesystem::is_directory(path))
    throw std::filesystem::filesystem_error("read", path, std::make_error_code(std::errc::is_a_directory));
  if (is_script) check_last_line(path, where);
  return translated(where, [&] {
    Session session(where);
    session.new_model();
    gmsh::merge(path.string());
    session.check();
    if (is_script && dimension_of_mesh() < 2) {
      gmsh::model::mesh::generate(dim ? dim : gmsh::model::getDimension());
      session.check();
    }
    auto mesh = take(where, is_script ? std::vector<PeriodicSide>() : periodic_sides_of_old_file(path, where));
    session.check();
    return mesh;
  });
}

template <class Take>
auto with_current_model(Take&& take) {
  constexpr std::string_view where = "current_model";
  if (!is_alive())
    fail("{}: no gmsh is alive in this process: call gmsh.initialize() and make a model first. In Python that must be the `gmsh` that loads "
         "the system's libgmsh (Debian: python3-gmsh), not one that brings its own",
         where);
  return translated(where, [&] {
    Session session(where);
    if (dimension_of_mesh() < 2) fail("{}: the model '{}' has no elements: call gmsh.model.mesh.generate first", where, session.model());
    auto mesh = take(where);
    session.check();
    return mesh;
  });
}

}  // namespace

template <int dim>
Mesh<dim> read_mesh(const std::filesystem::path& path) {
  return with_file(path, dim, mesh_of_model<dim>);
}

AnyMesh read_mesh(const std::filesystem::path& path) { return with_file(path, 0, any_mesh_of_model); }

template <int dim>
Mesh<dim> current_model() {
  return with_current_model([](std::string_view where) { return mesh_of_model<dim>(where); });
}

AnyMesh current_model() {
  return with_current_model([](std::string_view where) { return any_mesh_of_model(where); });
}

template <int dim>
Mesh<dim> mesh_by_gmsh(std::string_view where, double size, const std::function<void()>& draw) {
  return translated(where, [&] {
    Session session(where);
    session.new_model();
    session.set("Mesh.MeshSizeMax", size);
    session.set("Mesh.MeshSizeExtendFromBoundary", 0);  // sizes come from a field, or are the same everywhere
    draw();
    session.check();
    gmsh::model::mesh::generate(dim);
    session.check();
    return mesh_of_model<dim>(where);
  });
}

#define INSTANTIATE(dim)                                        \
  template Mesh<dim> read_mesh<dim>(const std::filesystem::path&); \
  template Mesh<dim> current_model<dim>();                      \
  template Mesh<dim> mesh_by_gmsh<dim>(std::string_view, double, const std::function<void()>&);
INSTANTIATE(2)
INSTANTIATE(3)
#undef INSTANTIATE

}  // namespace quicksand::meshes
