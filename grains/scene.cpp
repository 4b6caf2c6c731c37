// Building a scene and changing it between steps: everything that a user may get wrong is checked here. The step is in step.cpp.
#include "errors.hpp"
#include "simulation.hpp"

namespace quicksand {

namespace {

void check_finite(double value, const char* where, const char* what, std::size_t at) {
  if (!std::isfinite(value)) fail("{}: {} must be finite, got {} (grain {})", where, what, value, at);
}
template <int n>
void check_finite(const Vec<n>& value, const char* where, const char* what, std::size_t at) {
  for (int k = 0; k < n; ++k) check_finite(value[k], where, what, at);
}

}  // namespace

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
  if (names_.size() == 255) fail("set_friction: at most 255 materials, '{}' is one more", name);
  names_.push_back(name);
  pairs_.resize(names_.size() * (names_.size() + 1) / 2);
  return static_cast<std::uint8_t>(names_.size() - 1);
}

template <int dim>
Simulation<dim>::Simulation(const Vec<dim>& period) {
  for (int k = 0; k < dim; ++k)
    if (!std::isfinite(period[k]) || period[k] < 0)
      fail("Simulation: period must be > 0 m, or 0 along axes that are not periodic, got {} (axis {})", period[k], k);
  box_.period = period;
}

template <int dim>
int Simulation<dim>::add(std::span<const Vec<dim>> x, std::span<const double> radius, double density,
                         std::span<const Vec<dim>> velocity, std::span<const Spin<dim>> omega, const std::string& material) {
  const std::size_t n = x.size();
  if (radius.size() != n) fail("add: one radius per grain, got {} for {} grains", radius.size(), n);
  if (!velocity.empty() && velocity.size() != n) fail("add: one velocity per grain, got {} for {} grains", velocity.size(), n);
  if (!omega.empty() && omega.size() != n) fail("add: one spin per grain, got {} for {} grains", omega.size(), n);
  if (!(density > 0) || !std::isfinite(density)) fail("add: density must be > 0 kg/m^3, got {}", density);
  const std::uint8_t m = materials_.find(material, "add");
  for (std::size_t k = 0; k < n; ++k) {
    if (!(radius[k] > 0) || !std::isfinite(radius[k])) fail("add: radius must be > 0 m, got {} (grain {})", radius[k], k);
    for (int axis = 0; axis < dim; ++axis)
      if (box_.period[axis] > 0 && box_.period[axis] < 8 * radius[k])
        fail("add: a period must be at least four diameters, got {} m for radius {} m (grain {})", box_.period[axis],
             radius[k], k);
    check_finite(x[k], "add", "position [m]", k);
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
  neighbours_.forget();
  return first;
}

template <int dim>
int Simulation<dim>::add_plane(const Vec<dim>& point, const Vec<dim>& normal, const std::string& material) {
  if (!point.allFinite()) fail("add_plane: point [m] must be finite");
  if (!normal.allFinite() || !(normal.norm() > 0)) fail("add_plane: normal must be finite and not zero");
  Wall<dim> wall;
  wall.point = point;
  wall.normal = normal.normalized();
  wall.material = materials_.find(material, "add_plane");
  walls_.push_back(wall);
  neighbours_.forget();
  return static_cast<int>(walls_.size()) - 1;
}

template <int dim>
int Simulation<dim>::add_segment(const Vec<dim>& start, const Vec<dim>& end, const std::string& material) {
  if (dim != 2) fail("add_segment: segments are walls of 2D scenes");
  if (!start.allFinite() || !end.allFinite() || !((end - start).norm() > 0))
    fail("add_segment: start and end [m] must be finite and apart");
  Wall<dim> wall;
  wall.shape = Wall<dim>::Shape::segment;
  wall.point = start;
  wall.span = end - start;
  wall.material = materials_.find(material, "add_segment");
  walls_.push_back(wall);
  neighbours_.forget();
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
  if (!std::isfinite(velocity)) fail("drive: velocity must be finite, got {} m/s (wall {}, axis {})", velocity, wall, axis);
  walls_[wall].loaded[axis] = false;
  walls_[wall].inv_m[axis] = walls_[wall].load[axis] = 0.0;
  walls_[wall].v[axis] = velocity;
}

template <int dim>
void Simulation<dim>::load(int wall, int axis, double force, std::optional<double> mass) {
  check_wall(wall, "load", axis);
  if (!std::isfinite(force)) fail("load: load must be finite, got {} N (wall {}, axis {})", force, wall, axis);
  if (mass && (!(*mass > 0) || !std::isfinite(*mass))) fail("load: mass must be > 0 kg, got {} (wall {})", *mass, wall);
  walls_[wall].loaded[axis] = true;
  walls_[wall].load[axis] = force;
  if (mass) walls_[wall].mass = *mass;
}

template <int dim>
void Simulation<dim>::attach(int wall, std::span<const Vec<dim>> x, std::span<const double> radius,
                             const std::string& material) {
  check_wall(wall, "attach");
  if (radius.size() != x.size()) fail("attach: one radius per grain, got {} for {} grains", radius.size(), x.size());
  const std::uint8_t m = materials_.find(material, "attach");
  for (std::size_t k = 0; k < x.size(); ++k) {
    if (!(radius[k] > 0) || !std::isfinite(radius[k])) fail("attach: radius must be > 0 m, got {} (grain {})", radius[k], k);
    check_finite(x[k], "attach", "position [m]", k);
  }
  for (std::size_t k = 0; k < x.size(); ++k) {
    Body<dim> body{};
    body.v = walls_[wall].v;
    body.s = zero<Spin<dim>>();
    grains_.x.push_back(x[k]);
    grains_.body.push_back(body);
    grains_.r.push_back(radius[k]);
    grains_.id.push_back(-(++n_fixed_));
    grains_.wall.push_back(static_cast<std::int16_t>(wall));
    grains_.material.push_back(m);
  }
  if (!grains_.force.empty()) grains_.force.resize(grains_.x.size(), Vec<dim>::Zero());
  neighbours_.forget();
}

template <int dim>
void Simulation<dim>::set_friction(const std::string& a, const std::string& b, double friction) {
  if (!(friction >= 0) || !std::isfinite(friction)) fail("set_friction: friction must be >= 0, got {} ('{}' on '{}')", friction, a, b);
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
  if (!(ratio > 0 && ratio <= 1)) fail("set_inertia: I/(m r^2) must be in (0, 1], got {}", ratio);
  grains_.inertia = ratio;
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
void Simulation<dim>::set_position(std::span<const Vec<dim>> x) {
  set_by_id(x.size(), "set_position", "position");
  for (std::size_t k = 0; k < x.size(); ++k) check_finite(x[k], "set_position", "position [m]", k);
  for (int k = 0; k < grains_.size(); ++k)
    if (grains_.id[k] >= 0) grains_.x[k] = x[grains_.id[k]];
  neighbours_.forget();
}

template <int dim>
void Simulation<dim>::set_velocity(std::span<const Vec<dim>> v) {
  set_by_id(v.size(), "set_velocity", "velocity");
  for (std::size_t k = 0; k < v.size(); ++k) check_finite(v[k], "set_velocity", "velocity [m/s]", k);
  for (int k = 0; k < grains_.size(); ++k)
    if (grains_.id[k] >= 0) grains_.body[k].v = v[grains_.id[k]];
}

template <int dim>
void Simulation<dim>::set_omega(std::span<const Spin<dim>> omega) {
  set_by_id(omega.size(), "set_omega", "spin");
  for (std::size_t k = 0; k < omega.size(); ++k)
    check_finite(std::sqrt(squared(omega[k])), "set_omega", "spin [rad/s]", k);
  for (int k = 0; k < grains_.size(); ++k)
    if (grains_.id[k] >= 0) grains_.body[k].s = grains_.r[k] * omega[grains_.id[k]];
}

template class Simulation<2>;  // of the members defined here
template class Simulation<3>;

}  // namespace quicksand
