"""The makers' own printed examples of compensation tables, as far as they print the points."""

import pytest

from rtec.correction.tables import predict


def look_at_few_places(monkeypatch: pytest.MonkeyPatch, per_step: int = 2) -> None:
    """Have what a table leaves looked for at few places, where its size is not asked: a plane would take seconds."""
    for name, few in (("PER_STEP", per_step), ("LEAST", 20), ("FEW", 3), ("MANY", 20)):
        monkeypatch.setattr(predict, name, few)


SINUMERIK = """%_N_AX_EEC_INI
CHANDATA(1)
$AA_ENC_COMP[0,0,X1]=0.003 ; 1st compensation value (interpolation point 0): +3µm
$AA_ENC_COMP[0,1,X1]=0.01 ; +10µm
$AA_ENC_COMP[0,2,X1]=0.012 ; +12µm
$AA_ENC_COMP_STEP[0,X1]=1.0
$AA_ENC_COMP_MIN[0,X1]=-200.0
$AA_ENC_COMP_MAX[0,X1]=-198.0
$AA_ENC_COMP_IS_MODULO[0,X1]=0
M17
"""
"""Siemens 6FC5397-1BP40-3BA1, page 242: its first three of 801 points; so MAX is -198 instead of 600."""

SAG = """%_N_NC_CEC_INI
CHANDATA(1)
$AN_CEC [0.0] =0 ; 1. Compensation value (interpolation point 0) for X1: ± 0 µm
$AN_CEC [0.1] =0.01 ; 2. Compensation value (interpolation point 1) for X1: + 10 µm
$AN_CEC [0.2] =0.012 ; 3. Compensation value (interpolation point 2) for X1: + 12 µm
$AN_CEC_INPUT_AXIS[0] =(AX2) ; basic axis Y1
$AN_CEC_OUTPUT_AXIS[0] =(AX1) ; compensation axis X1
$AN_CEC_STEP[0] =6.73 ; distance between interpolation points 6.73 mm
$AN_CEC_MIN[0] =-400.0 ; compensation starts at Y1 = -400 mm
$AN_CEC_MAX[0] =-386.54
$AN_CEC_DIRECTION[0] =0 ; table applies in both traversing directions of Y1
$AN_CEC_MULT_BY_TABLE[0] =0
$AN_CEC_IS_MODULO[0] =0 ; compensation without modulo function
M17
"""
"""Siemens 6FC5397-1CP10-5BA0, page 222: the first three of its points, with its full stops; so MAX is not 400."""

BECKHOFF = """kopf.achs_nr                        2
kopf.log_achs_name                  Y AXIS
kw.ssfk.interval                    0
kw.ssfk.kw_startpos                 -200000
kw.ssfk.kw_nr_max                   3
kw.ssfk.unit                        1
kw.ssfk.bilateral                   1
kw.ssfk.table[0].setpoint           -200000
kw.ssfk.table[1].setpoint           -199306
kw.ssfk.table[2].setpoint           -198667
kw.ssfk.table[0].pos                0
kw.ssfk.table[1].pos                24
kw.ssfk.table[2].pos                -102
kw.ssfk.table[0].neg                0
kw.ssfk.table[1].neg                67
kw.ssfk.table[2].neg                80
"""
"""Beckhoff TF5200, non-equidistant bilateral SSFK: the first three of 140 points."""

CROSS = """# ****************************************
# Axis compensation data for Z-axis
# ****************************************
kopf.achs_nr                          3
kopf.log_achs_name                    Z
kw.crosscomp.last_index               2  /*Last valid index of the table*/
kw.crosscomp.master_ax_nr             1   /*Log. ax. number of the master axis*/
kw.crosscomp.unit                     1   /*0:Incr. 1:Metric in 0.1 µm*/
kw.crosscomp.n_cycles                 10
#
kw.crosscomp.table[0].setpoint        10735
kw.crosscomp.table[0].correction      3
kw.crosscomp.table[1].setpoint        11523
kw.crosscomp.table[1].correction      5
kw.crosscomp.table[2].setpoint        10000000  /*at 1000 mm of axis 3*/
kw.crosscomp.table[2].correction      1000      /*corr. of 0.1 mm for axis 1*/
"""
"""Beckhoff TF5200, 113391499: the first two points and the last, which is number 99 there."""

PLANE = """kopf.achs_nr                                     1
kopf.log_achs_name                               X
kw.crosscomp2.interval                           100000    /* 10 mm */
kw.crosscomp2.last_index_master1                 3
kw.crosscomp2.last_index_master2                 1
kw.crosscomp2.start_position_master1            -400000    /* -40 mm */
kw.crosscomp2.start_position_master2            -700000    /* -70 mm */
kw.crosscomp2.unit                               1         /* 0.1 my */
kw.crosscomp2.n_cycles                           10
kw.crosscomp2.master1_ax_nr                      2
kw.crosscomp2.master2_ax_nr                      3
kw.crosscomp2.table[ 0][ 0].correction          -3
kw.crosscomp2.table[ 0][ 1].correction          -1
kw.crosscomp2.table[ 0][ 2].correction           4
kw.crosscomp2.table[ 0][ 3].correction           9
kw.crosscomp2.table[ 1][ 0].correction          82
kw.crosscomp2.table[ 1][ 1].correction          77
kw.crosscomp2.table[ 1][ 2].correction          68
kw.crosscomp2.table[ 1][ 3].correction          63
"""
"""Beckhoff TF5200, 113417611: four points of its first row and four of its last, which is [100][90] to [100][93]."""

HEIDENHAIN = """Y = F(Z)
DATUM POINT –990
SETUP 14
0 Z–990 Y+0
1 Z–973.616 Y–0.06
2 Z–957.232 Y–0.09
3 Z–940.848
4 Z–924.464
5 Z–908.08 Y–0.12
6 Z–891.696 Y–0.12
7 Z–875.312 Y–0.1
8 Z–858.928 Y–0.09
"""
"""HEIDENHAIN technical manual TNC 406 / TNC 306, 3/97, page 4-21: all that it prints."""

FANUC = dict(zip(range(33, 50), [2, 1, 1, -2, 0, -1, 0, -1, 2, 1, 0, -1, -1, -2, 0, 1, 2], strict=True))
"""FANUC B-63980EN/01, page 100, by number of the point; 40 is at the reference position, 50 mm apart. In its figure the
sum is 0 at -400, 0 and 400 mm, 4 at its highest (-250 mm), and -1 at its lowest."""
