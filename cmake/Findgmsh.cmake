# gmsh::shared, the library that Python's `gmsh` loads too: a model made there is then visible here. Its own CMake files, which some
# installations have, may lead to a static one.
find_path(gmsh_INCLUDE_DIR gmsh.h)
find_library(gmsh_LIBRARY gmsh)
mark_as_advanced(gmsh_INCLUDE_DIR gmsh_LIBRARY)
include(FindPackageHandleStandardArgs)
find_package_handle_standard_args(gmsh REQUIRED_VARS gmsh_LIBRARY gmsh_INCLUDE_DIR
  REASON_FAILURE_MESSAGE "(Debian: libgmsh-dev, or without a fluid -DFLUID=OFF)")
if(gmsh_FOUND AND NOT TARGET gmsh::shared)
  add_library(gmsh::shared UNKNOWN IMPORTED)
  set_target_properties(gmsh::shared PROPERTIES IMPORTED_LOCATION ${gmsh_LIBRARY} INTERFACE_INCLUDE_DIRECTORIES ${gmsh_INCLUDE_DIR})
endif()
