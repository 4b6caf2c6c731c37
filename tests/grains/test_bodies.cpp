#include <gtest/gtest.h>
TEST(Empty, empty) {}
