// Building a scene and changing it between steps: everything that a user may get wrong is checked here. The step is in step.cpp.
#include "errors.hpp"
#include "simulation.hpp"

namespace quicksand {

namespace {

void check_finite(double value, const char* where, const char* what, std::size_t at) {
  if (!is_finite(value)) fail("{}: {} must be finite, got {} (grain {})", where, what, value, at);
}
template <int n>
void check_finite(const Vec<n>& value, const char* where, const char* what, std::size_t at) {
  for (int k = 0; k < n; ++k) check_finite(value[k], where, what, at);
}

}  // namespace

void check(const Settings& settings, const char* where) {
  const SolverSettings& solve = settings.solve;
  if (settings.threads < 1 || settings.threads > 1024) fail("{}: threads must be 1 to 1024, got {}", where, settings.threads);
  if (!(solve.tolerance > 0 && solve.tolerance <= 1)) fail("{}: tolerance must be in (0, 1], got {}", where, solve.tolerance);
  if (solve.max_sweeps < 1) fail("{}: max_sweeps must be >= 1, got {}", where, solve.max_sweeps);
  if (solve.active_sweeps < 1) fail("{}: active_sweeps must be >= 1, got {}", where, solve.active_sweeps);
  if (!(solve.omega >= 1 && solve.omega < 2)) fail("{}: omega must be in [1, 2), got {}", where, solve.omega);
  if (!(settings.sub_step_motion > 0 && settings.sub_step_motion <= 0.5))
    fail("{}: sub_step_motion must be in (0, 0.5], got {}", where, settings.sub_step_motion);
  if (!(settings.rest_speed >= 0 && is_finite(settings.rest_speed)))
    fail("{}: rest_speed must be >= 0 m/s and finite, got {}", where, settings.rest_speed);
}

std::uint8_t Materials::find(const std::string& name, const char* where) const {
  const auto at = std::find(names_.begin(), names_.end(), name);
  if (at == names_.end())
    fail("{}: unknown material '{}'; set_friction names materials, known: {}", where, name,
         names_.empty() ? "none" : fmt::format("{}", fmt::join(names_, ", ")));
  return static_cast<std::uint8_t>(at - names_.begin());
}

std::uint8_t Materials::find_or_add(const std::string& name) {
  const auto at = std::find(names_.begin(), names_.end(), name);
  if (at != names_.end()) return static_cast<std::uint8_t>(at - names_.begin());
  names_.push_back(name);
  pairs_.resize(names_.size() * (names_.size() + 1) / 2);
  return static_cast<std::uint8_t>(names_.size() - 1);
}

template <int dim>
Simulation<dim>::Simulation(const Vec<dim>& period) {
  for (int k = 0; k < dim; ++k)
    if (!is_finite(period[k]) || period[k] < 0)
      fail("Simulation: period must be > 0 m, or 0 along axes that are not periodic, got {} (axis {})", period[k], k);
  box_.period = period;
}

template <int dim>
void Simulation<dim>::check_grains(std::span<const Vec<dim>> x, std::span<const double> radius, const char* where) const {
  if (radius.size() != x.size()) fail("{}: one radius per grain, got {} for {} grains", where, radius.size(), x.size());
  const std::string what = fmt::format("{}: radius", where);
  for (std::size_t k = 0; k < x.size(); ++k) {
    check_positive(radius[k], what, "m", static_cast<std::ptrdiff_t>(k));
    for (int axis = 0; axis < dim; ++axis)
      if (box_.period[axis] > 0 && box_.period[axis] < 8 * radius[k])
        fail("{}: a period must be at least four diameters, got {} m for radius {} m (grain {})", where, box_.period[axis],
             radius[k], k);
    check_finite(x[k], where, "position [m]", k);
  }
}

// What was known of places holds no longer: grains or walls were added or moved from outside.
template <int dim>
void Simulation<dim>::places_changed() {
  neighbours_.forget();
  places_checked_ = contacts_current_ = false;
}

template <int dim>
int Simulation<dim>::add(std::span<const Vec<dim>> x, std::span<const double> radius, double density,
                         std::span<const Vec<dim>> velocity, std::span<const Spin<dim>> omega, const std::string& material) {
  const std::size_t n = x.size();
  if (!velocity.empty() && velocity.size() != n) fail("add: one velocity per grain, got {} for {} grains", velocity.size(), n);
  if (!omega.empty() && omega.size() != n) fail("add: one spin per grain, got {} for {} grains", omega.size(), n);
  check_positive(density, "add: density", "kg/m^3");
  check_grains(x, radius, "add");
  const std::uint8_t m = materials_.find(material, "add");
  for (std::size_t k = 0; k < n; ++k) {
    if (!velocity.empty()) check_finite(velocity[k], "add", "velocity [m/s]", k);
    if (!omega.empty()) check_finite(std::sqrt(squared(omega[k])), "add", "spin [rad/s]", k);
  }
  const int first = n_free_;
  for (std::size_t k = 0; k < n; ++k) {
    Body<dim> body{};
    body.v = velocity.empty() ? Vec<dim>::Zero() : velocity[k];
    body.s = omega.empty() ? zero<Spin<dim>>() : Spin<dim>(radius[k] * omega[k]);
    body.inv_m = 1.0 / (density * solid_volume<dim>(radius[k]));
    grains_.x.push_back(x[k]);
    grains_.body.push_back(body);
    grains_.r.push_back(radius[k]);
    grains_.id.push_back(n_free_++);
    grains_.wall.push_back(-1);
    grains_.material.push_back(m);
  }
  if (!grains_.force.empty()) grains_.force.resize(grains_.x.size(), Vec<dim>::Zero());
  if (dragged()) {
    drag_.coefficient.resize(n_free_, 0.0);
    if (!drag_.added_mass.empty()) drag_.added_mass.resize(n_free_, 0.0);
    for (auto* of_grain : {&drag_.velocity, &drag_.impulse, &drag_.contact_impulse}) of_grain->resize(n_free_, Vec<dim>::Zero());
    drag_.in_contact.resize(n_free_, 0);
  }
  places_changed();
  return first;
}

template <int dim>
void Simulation<dim>::remove(std::span<const int> ids) {
  std::vector<int> id_of(n_free_, 0);  // by old id; -1: leaves
  for (const int id : ids) {
    if (id < 0 || id >= n_free_) fail("remove: no grain {}, the scene has {}", id, n_free_);
    if (id_of[id] < 0) fail("remove: grain {} is named twice", id);
    id_of[id] = -1;
  }
  const std::vector<int> left(id_of);
  auto keep_ids = [&](auto& by_id) {  // of an array by id
    std::size_t at = 0;
    for (std::size_t id = 0; id < by_id.size(); ++id)
      if (left[id] == 0) by_id[at++] = by_id[id];
    by_id.resize(at);
  };
  keep_ids(drag_.coefficient), keep_ids(drag_.velocity), keep_ids(drag_.added_mass), keep_ids(drag_.impulse), keep_ids(drag_.contact_impulse), keep_ids(drag_.in_contact);
  n_free_ = 0;
  for (int& id : id_of)
    if (id == 0) id = n_free_++;

  const int n = grains_.size();
  std::vector<int> new_of_old(n);
  int stay = 0;
  for (int k = 0; k < n; ++k) new_of_old[k] = grains_.id[k] >= 0 && left[grains_.id[k]] < 0 ? -1 : stay++;
  auto keep = [&](auto& values) {
    if (values.empty()) return;
    for (int k = 0; k < n; ++k)
      if (new_of_old[k] >= 0) values[new_of_old[k]] = values[k];
    values.resize(stay);
  };
  keep(grains_.x), keep(grains_.body), keep(grains_.r), keep(grains_.id), keep(grains_.wall), keep(grains_.material), keep(grains_.force);
  for (std::int32_t& id : grains_.id)
    if (id >= 0) id = id_of[id];

  const std::vector<Block> old(neighbours_.blocks);
  neighbours_.remove(new_of_old);
  for (std::size_t b = 0; b < count_.size(); ++b) {
    const int begin = neighbours_.blocks[b].begin;
    int at = begin;
    for (int k = old[b].begin; k < old[b].begin + count_[b]; ++k) {
      Contact<dim> c = contacts_[k];
      c.i = new_of_old[c.i], c.j = new_of_old[c.j];
      if (c.i >= 0 && c.j >= 0) contacts_[at++] = c;
    }
    count_[b] = at - begin;
  }
  for (WallContact<dim>& c : wall_contacts_) c.j = new_of_old[c.j];
  std::erase_if(wall_contacts_, [](const WallContact<dim>& c) { return c.j < 0; });
  contacts_current_ = false;
}

template <int dim>
int Simulation<dim>::add_plane(const Vec<dim>& point, const Vec<dim>& normal, const std::string& material) {
  const std::string got = fmt::format("{}", fmt::join(normal, ", "));
  if (!is_finite(point.norm())) fail("add_plane: point [m] must be finite, got ({})", fmt::join(point, ", "));
  if (!is_finite(normal.norm()) || !(normal.norm() > 1e-30)) fail("add_plane: normal must be finite and not zero, got ({})", got);
  Wall<dim> wall;
  wall.point = point;
  wall.normal = normal.normalized();
  for (int k = 0; k < dim; ++k)  // a grain that goes through the boundary would come out behind such a plane
    if (box_.period[k] > 0 && std::abs(wall.normal[k]) > 1e-9)
      fail("add_plane: normal must be 0 along a periodic axis, got ({}) (axis {}, period {} m)", got, k, box_.period[k]);
  return add_wall(wall, material, "add_plane");
}

template <int dim>
int Simulation<dim>::add_segment(const Vec<dim>& start, const Vec<dim>& end, const std::string& material) {
  if (dim != 2) fail("add_segment: segments are walls of 2D scenes");
  if (!is_finite(start.norm()) || !is_finite(end.norm()) || !((end - start).norm() > 1e-30))
    fail("add_segment: start and end [m] must be finite and apart, got ({}) and ({})", fmt::join(start, ", "), fmt::join(end, ", "));
  Wall<dim> wall;
  wall.shape = Wall<dim>::Shape::segment;
  wall.point = start;
  wall.span = end - start;
  wall.normal[0] = -wall.span[1], wall.normal[1] = wall.span[0];
  wall.normal.normalize();
  return add_wall(wall, material, "add_segment");
}

template <int dim>
int Simulation<dim>::add_triangle(const Vec<dim>& a, const Vec<dim>& b, const Vec<dim>& c, const std::string& material) {
  if constexpr (dim != 3) {
    fail("add_triangle: triangles are walls of 3D scenes");
  } else {
    const std::string got = fmt::format("({}), ({}) and ({})", fmt::join(a, ", "), fmt::join(b, ", "), fmt::join(c, ", "));
    if (!is_finite(a.norm()) || !is_finite(b.norm()) || !is_finite(c.norm())) fail("add_triangle: corners [m] must be finite, got {}", got);
    Wall<dim> wall;
    wall.shape = Wall<dim>::Shape::triangle;
    wall.point = a, wall.span = b - a, wall.side = c - a;
    const Vec<3> area = cross(wall.span, wall.side);
    // Flatter than that its normal is no better than that of a line.
    if (!(area.norm() > 1e-9 * std::max(wall.span.squaredNorm(), wall.side.squaredNorm()))) fail("add_triangle: corners [m] must not be on one line, got {}", got);
    for (int k = 0; k < dim; ++k)
      if (const auto [low, high] = std::minmax({a[k], b[k], c[k]}); box_.period[k] > 0 && high - low > 0.5 * box_.period[k])
        fail("add_triangle: a triangle must be at most half a period long, got {} m of {} m (axis {})", high - low, box_.period[k], k);
    wall.normal = area.normalized();
    return add_wall(wall, material, "add_triangle");
  }
}

template <int dim>
std::vector<int> Simulation<dim>::add_facets(std::span<const std::array<Vec<dim>, dim>> facets, const std::string& material) {
  const std::size_t first = walls_.size();
  std::vector<int> numbers;
  try {
    for (const auto& corners : facets) {
      if constexpr (dim == 2) numbers.push_back(add_segment(corners[0], corners[1], material));
      else numbers.push_back(add_triangle(corners[0], corners[1], corners[2], material));
    }
  } catch (...) {
    walls_.resize(first);
    throw;
  }
  return numbers;
}

template <int dim>
int Simulation<dim>::add_wall(Wall<dim>& wall, const std::string& material, const char* where) {
  wall.material = materials_.find(material, where);
  walls_.push_back(wall);
  places_changed();
  return static_cast<int>(walls_.size()) - 1;
}

template <int dim>
void Simulation<dim>::check_wall(int wall, const char* where, int axis) const {
  if (wall < 0 || wall >= static_cast<int>(walls_.size()))
    fail("{}: no wall {}, the scene has {}", where, wall, walls_.size());
  if (axis < 0 || axis >= dim) fail("{}: axis must be 0 to {}, got {}", where, dim - 1, axis);
}

template <int dim>
void Simulation<dim>::drive(int wall, int axis, double velocity) {
  check_wall(wall, "drive", axis);
  if (!is_finite(velocity)) fail("drive: velocity must be finite, got {} m/s (wall {}, axis {})", velocity, wall, axis);
  walls_[wall].loaded[axis] = false;
  walls_[wall].inv_m[axis] = walls_[wall].load[axis] = 0.0;
  walls_[wall].v[axis] = velocity;
  contacts_current_ = false;
}

template <int dim>
void Simulation<dim>::set_load(int wall, int axis, double force, std::optional<double> mass) {
  check_wall(wall, "set_load", axis);
  if (!is_finite(force)) fail("set_load: load must be finite, got {} N (wall {}, axis {})", force, wall, axis);
  if (mass) check_positive(*mass, "set_load: mass", "kg");
  walls_[wall].loaded[axis] = true;
  walls_[wall].load[axis] = force;
  if (mass) walls_[wall].mass = *mass;
  contacts_current_ = false;
}

template <int dim>
void Simulation<dim>::attach(int wall, std::span<const Vec<dim>> x, std::span<const double> radius,
                             const std::string& material) {
  check_wall(wall, "attach");
  check_grains(x, radius, "attach");
  const std::uint8_t m = materials_.find(material, "attach");
  for (std::size_t k = 0; k < x.size(); ++k) {
    Body<dim> body{};
    body.v = walls_[wall].v;
    body.s = zero<Spin<dim>>();
    grains_.x.push_back(x[k]);
    grains_.body.push_back(body);
    grains_.r.push_back(radius[k]);
    grains_.id.push_back(-(++n_fixed_));
    grains_.wall.push_back(wall);
    grains_.material.push_back(m);
  }
  if (!grains_.force.empty()) grains_.force.resize(grains_.x.size(), Vec<dim>::Zero());
  places_changed();
}

template <int dim>
void Simulation<dim>::set_friction(const std::string& a, const std::string& b, double friction) {
  if (!(friction >= 0) || !is_finite(friction)) fail("set_friction: friction must be >= 0 and finite, got {} ('{}' on '{}')", friction, a, b);
  if (a.empty() || b.empty()) fail("set_friction: a material needs a name, got '{}' and '{}'", a, b);
  const auto& names = materials_.names();
  auto is_new = [&](const std::string& name) { return std::find(names.begin(), names.end(), name) == names.end(); };
  if (names.size() + is_new(a) + (b != a && is_new(b)) > 255) fail("set_friction: at most 255 materials, got '{}' and '{}'", a, b);
  const int i = materials_.find_or_add(a), j = materials_.find_or_add(b);
  materials_.pair(i, j).friction = friction;
}

template <int dim>
void Simulation<dim>::set_restitution(const std::string& a, const std::string& b, double normal, double tangential) {
  if (!(normal >= 0 && normal <= 1)) fail("set_restitution: normal restitution must be in [0, 1], got {}", normal);
  if (!(tangential >= 0 && tangential <= 1))
    fail("set_restitution: tangential restitution must be in [0, 1], got {}", tangential);
  Materials::Pair& pair = materials_.pair(materials_.find(a, "set_restitution"), materials_.find(b, "set_restitution"));
  pair.normal = normal;
  pair.tangential = tangential;
}

template <int dim>
void Simulation<dim>::set_inertia(double ratio) {
  if (!(ratio > 1e-30 && ratio <= 1)) fail("set_inertia: I/(m r^2) must be in (0, 1], got {}", ratio);
  grains_.inertia = ratio;
  contacts_current_ = false;
}

template <int dim>
void Simulation<dim>::set_by_id(std::size_t size, const char* where, const char* what) const {
  if (size != static_cast<std::size_t>(n_free_)) fail("{}: one {} per grain, got {} for {} grains", where, what, size, n_free_);
}

template <int dim>
void Simulation<dim>::set_force(std::span<const Vec<dim>> force) {
  if (force.empty()) return grains_.force.clear();
  set_by_id(force.size(), "set_force", "force");
  for (std::size_t k = 0; k < force.size(); ++k) check_finite(force[k], "set_force", "force [N]", k);
  grains_.force.assign(grains_.x.size(), Vec<dim>::Zero());
  for (int k = 0; k < grains_.size(); ++k)
    if (grains_.id[k] >= 0) grains_.force[k] = force[grains_.id[k]];
}

template <int dim>
void Simulation<dim>::set_drag(std::span<const double> coefficient, std::span<const Vec<dim>> velocity, std::span<const double> added_mass) {
  if (coefficient.empty() && velocity.empty() && added_mass.empty()) {
    drag_ = {};
    spin_ratios_.clear();
  } else {
    set_by_id(coefficient.size(), "set_drag", "coefficient");
    set_by_id(velocity.size(), "set_drag", "velocity");
    if (!added_mass.empty()) set_by_id(added_mass.size(), "set_drag", "added mass");
    for (std::size_t k = 0; k < coefficient.size(); ++k) {
      if (!(coefficient[k] >= 0) || !is_finite(coefficient[k]))
        fail("set_drag: coefficient must be >= 0 kg/s and finite, got {} (grain {})", coefficient[k], k);
      check_finite(velocity[k], "set_drag", "velocity [m/s]", k);
    }
    for (std::size_t k = 0; k < added_mass.size(); ++k)
      if (!(added_mass[k] >= 0) || !is_finite(added_mass[k])) fail("set_drag: added mass must be >= 0 kg and finite, got {} (grain {})", added_mass[k], k);
    drag_.coefficient.assign(coefficient.begin(), coefficient.end());
    drag_.velocity.assign(velocity.begin(), velocity.end());
    drag_.added_mass.assign(added_mass.begin(), added_mass.end());
    for (auto* of_step : {&drag_.impulse, &drag_.contact_impulse}) of_step->resize(n_free_, Vec<dim>::Zero());
    drag_.in_contact.resize(n_free_, 0);
  }
  contacts_current_ = false;
}

template <int dim>
const std::vector<Vec<dim>>& Simulation<dim>::drag_impulse() const {
  if (!dragged()) fail("drag_impulse: there is no drag; call set_drag");
  return drag_.impulse;
}

template <int dim>
const std::vector<Vec<dim>>& Simulation<dim>::contact_impulse() const {
  if (!dragged()) fail("contact_impulse: kept only while there is drag; call set_drag");
  return drag_.contact_impulse;
}

template <int dim>
const std::vector<std::uint8_t>& Simulation<dim>::in_contact() const {
  if (!dragged()) fail("in_contact: kept only while there is drag; call set_drag");
  return drag_.in_contact;
}

template <int dim>
void Simulation<dim>::set_position(std::span<const Vec<dim>> x) {
  set_by_id(x.size(), "set_position", "position");
  for (std::size_t k = 0; k < x.size(); ++k) check_finite(x[k], "set_position", "position [m]", k);
  for (int k = 0; k < grains_.size(); ++k)
    if (grains_.id[k] >= 0) grains_.x[k] = x[grains_.id[k]];
  places_changed();
}

template <int dim>
void Simulation<dim>::set_velocity(std::span<const Vec<dim>> v) {
  set_by_id(v.size(), "set_velocity", "velocity");
  contacts_current_ = false;
  for (std::size_t k = 0; k < v.size(); ++k) check_finite(v[k], "set_velocity", "velocity [m/s]", k);
  for (int k = 0; k < grains_.size(); ++k)
    if (grains_.id[k] >= 0) grains_.body[k].v = v[grains_.id[k]];
}

template <int dim>
void Simulation<dim>::set_spin(std::span<const Spin<dim>> omega) {
  set_by_id(omega.size(), "set_spin", "spin");
  contacts_current_ = false;
  for (std::size_t k = 0; k < omega.size(); ++k)
    check_finite(std::sqrt(squared(omega[k])), "set_spin", "spin [rad/s]", k);
  for (int k = 0; k < grains_.size(); ++k)
    if (grains_.id[k] >= 0) grains_.body[k].s = grains_.r[k] * omega[grains_.id[k]];
}

template class Simulation<2>;  // of the members defined here
template class Simulation<3>;

}  // namespace quicksand
