"""What all parts of the package use: errors, margins, geometry, files, cores and devices."""
