#!/bin/sh
# Fails before it has said anything.
echo "no camera" >&2
exit 3
