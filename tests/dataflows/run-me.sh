#!/bin/sh
# Stands in for a binary of the user's own with one operator. What it prints is the format that such binaries speak, fixed here.
case "$1" in
--describe) cat "$(dirname "$0")/run-me.json" ;;
--check-config)
    question=$(cat)
    case "$question" in
    *'"gain":0.5'* | *'"config":null'*) findings='' ;;
    *) findings='{"path":["gain"],"message":"got something else, allowed is 0.5","hint":"a half will do"}' ;;
    esac
    echo "{\"format\":1,\"shape\":null,\"findings\":[$findings],\"period_ns\":20000000,\"exclusive\":false}"
    ;;
*) exit 2 ;;
esac
