# Completes the options of `ros2 run adxl_ros NAME` and `./run NAME` from their --help, and the
# names after ./run. Source it after ROS 2: what ros2 completes by itself stays.

declare -A _adxl_ros_options
_adxl_ros_before=$(complete -p ros2 2>/dev/null | sed -n 's/.* -F \([^ ]*\).*/\1/p')
[ "$_adxl_ros_before" != _adxl_ros ] || _adxl_ros_before=

_adxl_ros() {
    local word=${COMP_WORDS[COMP_CWORD]} last=1 call
    if [ "$1" = ros2 ]; then
        last=3
        if [ "${COMP_WORDS[*]:1:2}" != 'run adxl_ros' ] || [ "$COMP_CWORD" -le 3 ]; then
            [ -z "$_adxl_ros_before" ] || "$_adxl_ros_before" "$@"
            return
        fi
    elif [ "$COMP_CWORD" = 1 ]; then
        compopt +o nospace
        mapfile -t COMPREPLY < <(compgen -W "$("$1" '' 2>&1 | sed -n 's/.*there are: //p')" -- "$word")
        return
    fi
    compopt +o nospace
    call="${COMP_WORDS[*]:0:last + 1}"
    if [[ $word == -* ]]; then
        [ -n "${_adxl_ros_options[$call]}" ] || _adxl_ros_options[$call]=$(
            "${COMP_WORDS[@]:0:last + 1}" --help 2>/dev/null | grep -o -- '--[a-z][a-z0-9-]*' | sort -u)
        mapfile -t COMPREPLY < <(compgen -W "${_adxl_ros_options[$call]}" -- "$word")
    fi
}

complete -o nospace -o default -o bashdefault -F _adxl_ros ros2 ./run
