#!/bin/sh
# Prints the version of all programs and packages: that of the workspace, its one place.
set -eu
sed -n '/^\[workspace.package\]/,/^$/s/^version = "\(.*\)"/\1/p' "$(dirname "$0")/../Cargo.toml"
