"""What every room uses: errors, margins, geometry, files, cores and devices."""
