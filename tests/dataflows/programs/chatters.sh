#!/bin/sh
# Greets before it answers.
echo "hello from my operator"
