#!/bin/sh
# Stands in for a binary of the user's own.
exit 0
