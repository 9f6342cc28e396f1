#!/bin/sh
# Has two operators, of which one has ports of another type and version.
port='{"name":"image","doc":"Frames.","message_type":{"name":"carril/Image","version":2},"triggers":true,"optional":false,"external":false}'
rest='"outputs":[],"state_version":1,"config_schema":{},"has_defaults":true'
case "$1" in
--describe)
    echo "{\"format\":1,\"carril\":\"0.1.0\",\"operators\":["
    echo "{\"name\":\"newer\",\"summary\":\"Takes images to come.\",\"inputs\":[$port],$rest},"
    echo "{\"name\":\"idle\",\"summary\":\"Does nothing.\",\"inputs\":[],$rest}]}"
    ;;
--check-config)
    cat >/dev/null
    echo '{"format":1,"shape":null,"findings":[],"period_ns":null,"exclusive":false}'
    ;;
esac
